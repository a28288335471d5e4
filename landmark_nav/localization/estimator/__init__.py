"""One estimator of pose, calibration and map errors; see docs/estimator.md."""
