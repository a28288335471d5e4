"""When an expected pose is hardly known."""

from __future__ import annotations

from landmark_nav.types import FloatArray

__all__ = ['is_prior_uncertain']

# Sigmas of position (root of the trace) and heading beyond which a pose leaves open what landmarks
# look like, and bearings are not linear.
_WIDE_M, _WIDE_RAD = 0.1, 0.05


def is_prior_uncertain(covariance: FloatArray) -> bool:
    """Whether a pose with this covariance (3, 3) of x, y, heading, m and rad, is hardly known."""
    x, y, heading = covariance.diagonal().tolist()
    return not (x + y <= _WIDE_M**2 and heading <= _WIDE_RAD**2)
