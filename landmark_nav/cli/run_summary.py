"""What `landmark-nav evaluate` says of a run, for a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from landmark_nav.cli.lines import wrapped
from landmark_nav.evaluation.report.tables import cell, ESTIMATES, nees_range

__all__ = ['error_table', 'run_summary']

# Stretches without tracking that are listed; the others are in the JSON.
_MOST_SPELLS = 6


def run_summary(report: Mapping[str, Any]) -> str:
    """Summarize a run, by the report of `run_report`."""
    known = report['fused']['position_rmse_m'] is not None
    lines = [f'WARNING: {report["warning"]}'] if report['warning'] else []
    lines += error_table(report) if known else ['no errors: no ground truth at the images']
    if report.get('aligned'):
        left = cell(report['fused_after_scale']['position_rmse_m'], 100.0, 2)
        lines.append(
            f'the map has a frame of its own: errors after one rigid alignment. Its metre is '
            f'{report["scale"]:.4f} m long; after scaling, the RMSE of fused is {left} cm'
        )
    if report['found'] is not None:
        x, y, heading = report['found']['pose']
        lines.append(
            f'place found after {report["found"]["after_s"]:.1f} s: ({x:.2f}, {y:.2f}) m, '
            f'{np.degrees(heading):.1f} deg'
        )
    lines += [
        f'{spell["status"]} {_when(spell)}: {spell["reason"]}'
        for spell in report['spells'][:_MOST_SPELLS]
    ]
    if len(report['spells']) > _MOST_SPELLS:
        lines.append(f'... {len(report["spells"]) - _MOST_SPELLS} more in --json')
    claimed = report['claimed']
    lines += [
        f'{report["frames"]} images, {report["fixes"]} fixes, availability '
        f'{report["availability"]:.3f}, {report["landmarks"]} landmarks in the map',
        f'claimed sigma {100.0 * claimed["position_median_m"]:.2f} cm, '
        f'{claimed["heading_median_deg"]:.3f} deg in the median, '
        f'{100.0 * claimed["position_p95_m"]:.2f} cm at 95 %',
        *(_consistency(report) if known else []),
        _camera(report['calibration']),
        f'update {report["update_ms"]["median"]:.1f} ms, 95 % within '
        f'{report["update_ms"]["p95"]:.1f} ms; {report["realtime_factor"]:.1f} times real time',
        f'result {report["result_hash"][:16]}',
    ]
    return wrapped(lines)


def error_table(report: Mapping[str, Any]) -> list[str]:
    """Lines of a table of the errors of each estimate."""
    lines = [
        f'{"error":<14}{"position [cm]":>36}{"heading [deg]":>20}',
        f'{"":<14}{"RMSE":>9}{"median":>9}{"95 %":>9}{"max":>9}{"RMSE":>11}{"95 %":>9}',
    ]
    keys = ('rmse', 'median', 'p95', 'max')
    for name in filter(report.__contains__, ESTIMATES):
        figures = report[name]
        cells = [cell(figures[f'position_{key}_m'], 100.0, 2) for key in keys]
        cells += [cell(figures[f'heading_{key}_deg'], 1.0, 3) for key in ('rmse', 'p95')]
        widths = (9, 9, 9, 9, 11, 9)
        row = (f'{text:>{width}}' for text, width in zip(cells, widths, strict=True))
        lines.append(f'{name:<14}' + ''.join(row))
    return lines


def _consistency(report: Mapping[str, Any]) -> list[str]:
    nees = report['nees']
    return [
        f'NEES {cell(nees["mean"], 1.0, 2)} in the mean (3 is ideal'
        f'{nees_range(nees["interval_95"])}); {cell(nees["inside_95"], 100.0, 1)} % within 95 %',
        f'RMSE {cell(report["crlb_ratio"], 1.0, 2)} times the Cramer-Rao bound',
        f'images with an error of over 5 sigma and no warning: {report["silently_wrong"]}',
    ]


def _camera(known: Mapping[str, Any]) -> str:
    delay, yaw = known['joint_delay'], known['axis_yaw']
    late = f'{1e3 * abs(delay["value"]):.1f} ms {"early" if delay["value"] < 0.0 else "late"}'
    return (
        f'camera: joint_states {late} (sigma {1e3 * delay["sigma"]:.1f}), turned by '
        f'{np.degrees(yaw["value"] - yaw["prior"]):.2f} deg (sigma {np.degrees(yaw["sigma"]):.2f})'
    )


def _when(spell: Mapping[str, Any]) -> str:
    begin, end = (f'{spell[key]:.1f}' for key in ('from_s', 'to_s'))
    return f'at {begin} s' if begin == end else f'from {begin} to {end} s'
