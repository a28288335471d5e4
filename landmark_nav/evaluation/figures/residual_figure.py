"""Residuals of a drive before and after a calibration."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from landmark_nav.evaluation.calibration_run import Residuals
from landmark_nav.evaluation.figures.style import FUSED, new_figure, ODOMETRY, plain, save

__all__ = ['draw_residuals']

# Outliers of less weight are not drawn; axes reach to this quantile.
_LEAST_WEIGHT, _REACH = 0.1, 0.99


def draw_residuals(before: Residuals, after: Residuals, path: Path | BytesIO) -> None:
    """Draw both, to the right and down, against time."""
    figure = new_figure(9.0, 5.0)
    for k, (axes, where) in enumerate(
        zip(figure.subplots(2, 1, sharex=True), ('to the right', 'down'), strict=True)
    ):
        every = np.concatenate([before.points_px[:, k], after.points_px[:, k], [1.0]])
        for found, color, name in ((before, ODOMETRY, 'before'), (after, FUSED, 'after')):
            kept = found.weights > _LEAST_WEIGHT
            axes.plot(
                found.seconds[kept],
                found.points_px[kept, k],
                '.',
                color=color,
                markersize=3,
                label=f'{name}: {found.rms_px[k]:.2f} px RMS',
            )
        reach = 1.2 * float(np.quantile(np.abs(every), _REACH))
        axes.set_ylim(-reach, reach)
        axes.set_ylabel(f'residual {where} [px]')
        axes.legend(loc='upper right', ncols=2)
        plain(axes)
    axes.set_xlabel('time [s]')
    figure.suptitle('Landmarks in images, measured minus predicted')
    save(figure, path)
