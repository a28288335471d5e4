"""Relative poses of sweeps, from features that their panoramas share."""
