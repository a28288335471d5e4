"""Pose of a sweep, measured from coloured papers."""
