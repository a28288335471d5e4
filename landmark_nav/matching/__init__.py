"""
Template matching: normalized cross-correlation, then sub-pixel alignment.

Template and search image must have the same geometry: the learner matches wall textures, the
localizer matches camera images.
"""
