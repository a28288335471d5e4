"""A robot that teaches itself where it is, with one turning camera."""
