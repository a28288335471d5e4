"""Angles, planar poses, camera, cylinder, patches and walls: pure functions and values."""
