"""Capture of a sweep: for each step, turn the camera, let it settle and keep one good frame."""
