"""Quality of a panorama, and the calibration estimated from its sweep."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Largest number of pans in a message.
_MAX_LISTED = 4
# Least size of a correction, in sigmas, that is not noise.
SIGNIFICANT = 4.0


@dataclass(frozen=True)
class CalibrationTerm:
    """Correction of camera or mount by a sweep (SI units, radians, or relative), and its sigma."""

    name: str
    value: float
    sigma: float

    @property
    def significant(self) -> bool:
        """Whether the correction is not just noise."""
        return abs(self.value) > SIGNIFICANT * self.sigma

    def __str__(self) -> str:
        """Text in degrees, millimetres or per cent."""
        if self.name in ('tilt', 'roll', 'axis_roll', 'axis_pitch'):
            factor, unit = 57.29577951308232, 'deg'
        elif self.name in ('forward', 'left'):
            factor, unit = 1e3, 'mm'
        else:
            factor, unit = (1.0, '') if self.name == 'distortion' else (100.0, '%')
        name = self.name.replace('_', ' ')
        return f'{name} {factor * self.value:+.3f} +- {factor * self.sigma:.3f} {unit}'.strip()


@dataclass(frozen=True)
class PanoramaQuality:
    """
    Quality of a panorama, and the calibration estimated from its sweep.

    `sharpness` is the Tenengrad: mean squared gradient, grey levels squared per pixel squared.
    `closure_rad` is None for a part of a turn, and for a full turn in which too little can be
    matched at the pans `gaps_rad`. `residual_px` and `before_px` are the median disagreement of
    overlapping frames after and before calibration; `vignetting` is the share of light lost in the
    corners, which was corrected; `gain_spread` is the relative standard deviation of the
    exposures.
    """

    sharpness: float = 0.0
    closure_rad: float | None = None
    gaps_rad: tuple[float, ...] = ()
    residual_px: float = float('nan')
    before_px: float = float('nan')
    vignetting: float = 0.0
    gain_spread: float = 0.0
    calibration: tuple[CalibrationTerm, ...] = ()

    def of(self, sharpness: float, vignetting: float, gain_spread: float) -> PanoramaQuality:
        """Return a copy with the values measured in the image."""
        return replace(self, sharpness=sharpness, vignetting=vignetting, gain_spread=gain_spread)

    @property
    def closure(self) -> str:
        """Text of the closure error, or why it is unknown; empty for a part of a turn."""
        if self.closure_rad is not None:
            return f'closure error {abs(np.degrees(self.closure_rad)):.4f} deg'
        pans = ', '.join(f'{np.degrees(pan):.0f}' for pan in self.gaps_rad[:_MAX_LISTED])
        if len(self.gaps_rad) > _MAX_LISTED:
            pans += f' and {len(self.gaps_rad) - _MAX_LISTED} more'
        return f'closure unknown: nothing to match near pan {pans} deg' if pans else ''

    def __str__(self) -> str:
        """Text in one line."""
        parts = [f'sharpness {self.sharpness:.0f}']
        if self.closure:
            parts.append(self.closure)
        if np.isfinite(self.residual_px):
            before = f'{self.before_px:.2f} uncalibrated'
            parts.append(f'frames agree to {self.residual_px:.2f} px ({before})')
        words = [str(term) for term in self.calibration if term.significant]
        parts.append(f'corrected: {", ".join(words)}' if words else 'no significant correction')
        return ', '.join(parts)
