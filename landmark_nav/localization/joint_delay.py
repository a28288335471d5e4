"""Delay of the joint states' stamps."""

from __future__ import annotations

from typing import NamedTuple

# Sigma below which a delay is known: half a degree at 2 rad/s.
_KNOWN_S = 0.005
# Sigma of an unknown delay, for headings found while the pan turns.
DELAY_BOUND_S = 0.1
# A delay is corrected if it exceeds this number of sigmas and this harmless value.
_SIGNIFICANT, _LEAST_DELAY_S = 4.0, 5e-4


class JointDelay(NamedTuple):
    """Stamp of joint states minus stamp of an image taken at the same time."""

    delay_s: float = 0.0
    sigma_s: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether the delay is known well enough."""
        return self.sigma_s < _KNOWN_S

    @property
    def matters(self) -> bool:
        """Whether the delay is significant, and large enough to do harm."""
        return abs(self.delay_s) > max(_SIGNIFICANT * self.sigma_s, _LEAST_DELAY_S)
