"""Synthesis of a cylindrical panorama from the frames of a sweep."""
