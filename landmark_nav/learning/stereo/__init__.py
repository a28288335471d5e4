"""Stereo: patches of one panorama matched in others."""
