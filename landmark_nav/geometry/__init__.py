"""Angles, planar poses, camera, cylinder and walls: no images, no state."""
