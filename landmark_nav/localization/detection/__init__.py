"""Landmarks found in an image: what to expect, how it looks, where it is."""
