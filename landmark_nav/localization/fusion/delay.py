"""When a measured delay of the joints' stamps is worth a correction."""

from __future__ import annotations

__all__ = ['delay_matters']

# So many sigmas are no chance, and less than this does no harm.
_SIGNIFICANT = 4.0
_LEAST_DELAY_S = 5e-4


def delay_matters(delay_s: float, sigma_s: float) -> bool:
    """Whether a delay is more than chance, and does harm."""
    return abs(delay_s) > max(_SIGNIFICANT * sigma_s, _LEAST_DELAY_S)
