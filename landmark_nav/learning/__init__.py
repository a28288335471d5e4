"""From sweeps of the camera to a map of landmarks: the stages in order in `pipeline`."""
