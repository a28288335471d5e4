"""From an image and a map to a pose: the stages in order in `pipeline`."""
