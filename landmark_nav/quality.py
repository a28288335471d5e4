"""What a sweep says of its camera and mount, and how good its panorama is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Pans that a line names at most.
_LISTED = 4


@dataclass(frozen=True)
class CalibrationTerm:
    """What a sweep says of camera or mount: a correction (SI, radians, or relative), its sigma."""

    name: str
    value: float
    sigma: float
    used: bool

    def __str__(self) -> str:
        """For a person: degrees, millimetres, per cent."""
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
    How good a panorama is, and what its sweep showed of camera and mount.

    `sharpness` is its Tenengrad, the mean squared gradient in grey levels squared a pixel squared;
    `closure_rad` by how much the turn fails to close, None for a part of a turn, and for a full
    one in which too little is to be matched at the pans `gaps_rad`; `residual_px` how far the
    frames disagree in the median, `before_px` before calibration; `vignetting` the light lost in
    the corners that was made up for, `gain_spread` the spread of exposures.
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
        """The same with what the image shows."""
        return replace(self, sharpness=sharpness, vignetting=vignetting, gain_spread=gain_spread)

    @property
    def closure(self) -> str:
        """By how much the turn fails to close, or why nobody knows; nothing for a part of one."""
        if self.closure_rad is not None:
            return f'closure error {abs(np.degrees(self.closure_rad)):.4f} deg'
        pans = ', '.join(f'{np.degrees(pan):.0f}' for pan in self.gaps_rad[:_LISTED])
        if len(self.gaps_rad) > _LISTED:
            pans += f' and {len(self.gaps_rad) - _LISTED} more'
        return f'closure unknown: nothing to match near pan {pans} deg' if pans else ''

    def __str__(self) -> str:
        """For a person, in one line."""
        parts = [f'sharpness {self.sharpness:.0f}']
        if self.closure:
            parts.append(self.closure)
        if np.isfinite(self.residual_px):
            parts.append(
                f'frames agree to {self.residual_px:.2f} px ({self.before_px:.2f} before)'
            )
        used = [str(term) for term in self.calibration if term.used]
        parts.append(f'corrected: {", ".join(used)}' if used else 'nothing corrected')
        return ', '.join(parts)
