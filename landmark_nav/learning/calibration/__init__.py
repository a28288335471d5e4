"""Self-calibration of camera and mount from overlapping frames of a sweep."""
