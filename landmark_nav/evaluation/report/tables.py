"""Verdicts and tables for pages and terminals: metrics with units and explanations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from landmark_nav.calibration import MEANINGS, SHOWN_IN
from landmark_nav.evaluation.learning_report import NO_WALL

ESTIMATES = ('fused', 'triangulation', 'odometry', 'smoothed')
# States of localization by the terms of the glossary.

Table = dict[str, Any]
Row = dict[str, Any]

_SCALE_NOTE = 'Size of the map if this source alone gave its scale.'
_SCALE = {
    'scale from': 'What gives the length of a metre.',
    'sheets': 'Sheets of known size that were seen.',
    'map larger by [%]': 'By this source alone, beside all sources together.',
    'sigma [%]': 'Standard deviation of the scale by this source.',
    'variance inflated by': 'Where sources contradict each other, their variances grow.',
}
_SWEEPS = {
    'sweep': 'Number of the sweep, in the order of the bag.',
    'frames': 'Images of the sweep that make its panorama.',
    'x [m]': 'Place of base_link in the map.',
    'y [m]': 'Place of base_link in the map.',
    'heading [deg]': 'Direction of base_link, counter-clockwise from x of the map.',
    'sigma [mm]': 'Standard deviation of the place, by its covariance.',
    'error [mm]': 'Distance from the true place, where the bag holds ground_truth/odom.',
    'candidates': 'Conspicuous patches of this panorama.',
    'elected': 'Those of them that are landmarks of the map.',
}
_STAGES = {
    'stage': 'Step of learning, in order.',
    'seconds': 'Time that it took, in all sweeps.',
    'peak memory [MB]': 'Greatest memory of the process until its end.',
}
_NOT_LANDMARKS = (
    (
        'Candidates not elected',
        'candidates',
        'refused',
        'Why a candidate is no landmark: each counts at the first reason.',
    ),
    ('Never candidates', 'patches', 'ambiguous', 'Why a conspicuous patch is no candidate.'),
)
_CALIBRATION = {
    'quantity': 'Of mount, lens and clocks.',
    'prior': 'Value of robot.yaml.',
    'estimate': 'Value that prior and recording give together.',
    'sigma': 'Standard deviation of the estimate.',
    'unit': 'Of prior, estimate and sigmas.',
    'observed': 'Whether the recording shows it: its sigma fell by 30 % or more.',
    'prior sigma': 'Standard deviation that robot.yaml gives.',
    'prior sigmas off': 'Difference from the prior over its sigma.',
}
_WHOSE = {
    'fused': 'Of odometry and all images so far: what odometry_fusion publishes.',
    'triangulation': 'Each image for itself, from three bearings or more.',
    'odometry': 'Wheels alone, from the start on.',
    'smoothed': 'With all of the recording at hand.',
}
_ERRORS = (
    ('position RMSE [cm]', 'position_rmse_m', 100.0, 2,
     'Root of the mean squared distance between estimated and true position.'),
    ('position median [cm]', 'position_median_m', 100.0, 2,
     'Half of the images are off by less.'),
    ('position 95 % [cm]', 'position_p95_m', 100.0, 2, '95 % of the images are off by less.'),
    ('position maximum [cm]', 'position_max_m', 100.0, 2, 'The worst image.'),
    ('heading RMSE [deg]', 'heading_rmse_deg', 1.0, 3,
     'Root of the mean squared error of the heading.'),
    ('heading 95 % [deg]', 'heading_p95_deg', 1.0, 3, '95 % of the images are off by less.'),
)  # fmt: skip


def cell(value: float | None, factor: float, digits: int) -> str:
    """Format a metric in another unit, zero without a sign, or a dash if it is None."""
    return '-' if value is None else f'{round(factor * value, digits) + 0.0:.{digits}f}'


def nees_range(interval: Sequence[float] | None) -> str:
    """Format the bounds within which the mean NEES is consistent, if they are known."""
    return f', {interval[0]:.2f} to {interval[1]:.2f} is consistent' if interval else ''


def _row(name: str, *cells: object, why: str = '', **more: object) -> Row:
    return {'cells': [name, *map(str, cells)], 'why': why, **more}


def _table(
    title: str,
    head: Iterable[str],
    rows: Iterable[Row],
    note: str = '',
    whys: Mapping[str, str] | None = None,
) -> Table:
    """Return a table; `whys` are explanations of columns."""
    table = {'title': title, 'head': list(head), 'rows': list(rows), 'note': note}
    return {**table, 'whys': whys or {}}


def _verdict(level: str, parts: Iterable[str]) -> dict[str, str]:
    text = '; '.join(filter(None, parts))
    return {'level': level, 'text': text if text.endswith('?') else f'{text}.'}


def drive_verdict(report: Mapping[str, Any]) -> dict[str, str]:
    """Summarise the accuracy of a drive, the consistency of its covariance, and its states."""
    fused, claimed, mean = report['fused'], report['claimed'], report['nees']['mean']
    interval, wrong = report['nees']['interval_95'], report['silently_wrong']
    level = 'good'
    if fused['position_rmse_m'] is None:
        level = 'open'
        good = (
            'No ground truth, so errors are unknown: the estimate claims a sigma of '
            f'{cell(claimed["position_median_m"], 100.0, 2)} cm and '
            f'{cell(claimed["heading_median_deg"], 1.0, 2)}° in the median'
        )
    else:
        good = (
            f'Position RMSE {cell(fused["position_rmse_m"], 100.0, 2)} cm, 95 % within '
            f'{cell(fused["position_p95_m"], 100.0, 2)} cm; heading RMSE '
            f'{cell(fused["heading_rmse_deg"], 1.0, 2)}°'
        )
    consistent = ''
    if mean is not None:
        consistent = f'NEES {mean:.2f}, where 3 is ideal'
        if interval:
            small, large = mean > interval[1], mean < interval[0]
            word = 'too small' if small else 'conservative' if large else 'consistent'
            consistent = f'covariance {word} (NEES {mean:.2f}{nees_range(interval)})'
            level = 'warning' if small else level
        elif integrity := report.get('integrity'):
            inside = cell(integrity['coverage_99'], 100.0, 1)
            consistent += f'; error inside the 99 % protection level in {inside} % of the images'
    spells = [s for s in report['spells'] if s['status'] == 'lost']
    if spells:
        level = 'warning'
        when = ', '.join(f'{s["from_s"]:.1f} to {s["to_s"]:.1f} s' for s in spells[:3])
        lost = f'lost {when}' + (f' and {len(spells) - 3} times more' if len(spells) > 3 else '')
    else:
        lost = 'never lost'
    if found := report.get('found'):
        lost = f'place found after {found["after_s"]:.1f} s, then {lost}'
    degraded = sum(s['status'] == 'degraded' for s in report['spells'])
    undetected = f'{wrong} images are over 5 sigma off and not reported' if wrong else ''
    if wrong or report.get('warning'):
        level = 'bad'
    parts = (good, consistent, lost, f'times degraded: {degraded}' if degraded else '')
    return _verdict(level, (*parts, undetected, report.get('warning') or ''))


def drive_tables(report: Mapping[str, Any]) -> list[Table]:
    """Errors, figures of merit, times that are not OK, calibration and checks of a drive."""
    names = [name for name in ESTIMATES if name in report]
    note = 'Errors are absolute in map, never aligned, at the stamps of the images.'
    if report.get('aligned'):
        note = (
            'The map has a frame of its own: errors are those after one rigid transformation; '
            f'its lengths are {report["scale"]:.4f} of the true ones.'
        )
    tables = [_table('Figures of merit', ('figure', 'value'), _merits(report))]
    if report['fused']['position_rmse_m'] is not None:
        rows = (
            _row(label, *(cell(report[n][key], factor, digits) for n in names), why=why)
            for label, key, factor, digits, why in _ERRORS
        )
        tables.insert(0, _table('Errors', ('error', *names), rows, note, _WHOSE))
    if spells := report['spells']:
        times = (tuple(f'{s[key]:.1f}' for key in ('from_s', 'to_s')) for s in spells)
        rows = (
            _row(s['status'], *at, s['reason'], time_s=s['from_s'])
            for s, at in zip(spells, times, strict=True)
        )
        head = ('state', 'from [s]', 'to [s]', 'reason')
        tables.append(_table('Times that are not OK', head, rows))
    if calibration := report.get('calibration'):
        tables.append(_calibration_table(calibration))
    if checks := [c for c in report.get('checks', ()) if c['level'] != 'ok']:
        rows = (_row(c['name'], c['level'], c['measured'], c['advice']) for c in checks)
        tables.append(_table('Checks', ('what', 'level', 'measured', 'advice'), rows))
    return tables


def _merits(report: Mapping[str, Any]) -> Iterable[Row]:
    nees, claimed = report['nees'], report['claimed']
    rows = [
        ('images', report['frames'], 'Images of the drive that were looked at.'),
        ('fixes', report['fixes'], 'Images, or views together, that gave a triangulated pose.'),
        ('availability', cell(report['availability'], 1.0, 3),
         'Share of the images whose fused state is not lost.'),
        ('landmarks in the map', report['landmarks'], 'What could be looked for.'),
        ('claimed sigma, median [cm]', cell(claimed['position_median_m'], 100.0, 2),
         'What the estimate says of its own error, by its covariance.'),
        ('NEES, mean', cell(nees['mean'], 1.0, 2) + nees_range(nees['interval_95']),
         'Normalised estimation error squared: errors over what the covariance claims. 3 is '
         'ideal for x, y and heading; larger means that the covariance is too small.'),
        ('NEES within 95 % [%]', cell(nees['inside_95'], 100.0, 1),
         'Share of the images inside the 95 % region of their covariance.'),
        ('undetected failures', cell(report['silently_wrong'], 1.0, 0),
         'Images that are off by more than five sigma while the state is OK. None is right.'),
    ]  # fmt: skip
    if integrity := report.get('integrity'):
        rows += [
            ('inside the protection level [%]', cell(integrity['coverage_99'], 100.0, 1),
             'Share of the images whose error stays within the level that should hold 99 %.'),
            ('protection level over error', cell(integrity['level_over_error_median'], 1.0, 1),
             'Median of the level over the error: how wide the level is for its safety.'),
        ]  # fmt: skip
    if 'crlb_ratio' in report:
        found, times = report['found'], report['update_ms']
        place = 'given'
        if found is not None:
            x, y, heading = found['pose']
            place = f'found after {found["after_s"]:.1f} s at ({x:.2f}, {y:.2f}) m, '
            place += f'{np.degrees(heading):.1f} deg'
        rows += [
            ('RMSE over Cramér-Rao bound', cell(report['crlb_ratio'], 1.0, 2),
             'The bound is the least error that any unbiased estimator reaches with these '
             'measurements: 1 is the best there is.'),
            ('place', place,
             'Whether the start was given, or found from images alone.'),
            ('update [ms]', f'{times["median"]:.1f}, 95 % within {times["p95"]:.1f}',
             'Computing time of one image.'),
            ('times real time', cell(report['realtime_factor'], 1.0, 1),
             'How much faster than the recording all of it was computed.'),
            ('result hash', report['result_hash'][:16],
             'The same for the same bag and map, run after run.'),
        ]  # fmt: skip
    return (_row(name, value, why=why) for name, value, why in rows)


def learning_verdict(report: Mapping[str, Any], warning: str) -> dict[str, str]:
    """Summarise the number of landmarks, their walls, and the sigmas of the sweeps' poses."""
    walls = report['landmarks_per_wall']
    found = report.get('unmeasured')
    worst_m, without_m = (
        max(float(np.hypot(*sweep[sigma][:2])) for sweep in report['sweeps'])
        for sigma in ('sigma', 'sigma_without_mount')
    )
    errors = [sweep['error_position_m'] for sweep in report['sweeps'] if 'error' in sweep]
    parts = (
        f'{report["elected"]} landmarks on {len(walls.keys() - {NO_WALL})} walls ('
        + ', '.join(f'{wall} {count}' for wall, count in walls.items())
        + f') of {report["candidates"]} candidates learned from {len(report["sweeps"])} sweeps',
        f'poses of the sweeps known to {1e3 * worst_m:.1f} mm (sigma, '
        f'{1e3 * without_m:.1f} mm of it apart from the mount'
        + (' and the scale)' if found else ')')
        + (f', off by at most {1e3 * max(errors):.1f} mm' if errors else ''),
        f'scale from {found["scale"]}, good to {100 * float(found["scale_sigma"]):.2g} %'
        if found
        else '',
        warning,
    )
    return _verdict('warning' if warning else 'good', parts)


def learning_tables(report: Mapping[str, Any]) -> list[Table]:
    """Sweeps, refusals and stages of learning."""
    sweeps = []
    for number, sweep in enumerate(report['sweeps'], 1):
        x, y, heading = sweep['pose']
        pose = f'{x:.3f}', f'{y:.3f}', f'{np.degrees(heading):.2f}'
        sigma = f'{1e3 * np.hypot(*sweep["sigma"][:2]):.1f}'
        error = cell(sweep.get('error_position_m'), 1e3, 1)
        counts = sweep['candidates'], sweep['elected']
        sweeps.append(_row(f'{number}', sweep['frames'], *pose, sigma, error, *counts))
    found = report.get('unmeasured', {}).get('sources', {})
    sources = []
    for name, s in found.items():
        scale, sigma = f'{100.0 * (s["scale"] - 1.0):+.2f}', f'{100.0 * s["sigma"]:.2g}'
        sources.append(_row(name, s['sheets'] or '-', scale, sigma, f'{s["inflation"]:.1f}'))
    stages = (
        _row(name.replace('_', ' '), f'{s["seconds"]:.1f}', f'{s["peak_memory_mb"]:.0f}')
        for name, s in report['stages'].items()
    )
    return [
        _table('Sweeps', _SWEEPS, sweeps, whys=_SWEEPS),
        *([_table('Scale', _SCALE, sources, _SCALE_NOTE, _SCALE)] if found else []),
        *(
            _table(
                name,
                (name.lower(), what),
                (_row(k, n) for k, n in report[key].items()),
                whys={name.lower(): why},
            )
            for name, what, key, why in _NOT_LANDMARKS
        ),
        _table('Stages', _STAGES, stages, whys=_STAGES),
    ]


def _calibration_table(table: Mapping[str, Mapping[str, Any]]) -> Table:
    """Prior and estimate of mount, lens and clocks, in units for people."""
    rows = []
    for name, row in table.items():
        factor, unit = SHOWN_IN[row['unit']]
        values = [cell(row[key], factor, 3) for key in ('prior', 'value', 'sigma')]
        values += [unit, 'yes' if row['observed'] else 'no']
        if 'difference_sigmas' in row:  # none from an exact prior
            off = row['difference_sigmas']
            values.append(cell(row['prior_sigma'], factor, 3))
            values.append('exact' if off is None else cell(off, 1.0, 1))
        rows.append(_row(name, *values, why=MEANINGS[name]))
    head = [*_CALIBRATION][: len(rows[0]['cells']) if rows else None]
    note = 'Observed: the recording shows it; its sigma fell by 30 % or more.'
    return _table('Calibration', head, rows, note, _CALIBRATION)


def calibration_tables(report: Mapping[str, Any]) -> list[Table]:
    """The calibration, and the motions to record for unobserved quantities."""
    wanted = [_row(', '.join(one['quantities']), one['motion']) for one in report['unobserved']]
    wanted += [
        _row(' and '.join(one['quantities']), 'they look alike here: their '
             f'{"sum" if one["correlation"] < 0.0 else "difference"} is known better than each')
        for one in report['trade_offs']
    ]  # fmt: skip
    if (slip := report['side_slip_bound_rad']) is not None:
        left = (
            f'side slip of the wheels leaves {np.degrees(slip):.2f} deg'
            if slip < np.pi
            else 'there were none'
        )
        wanted.append(_row('axis_yaw (pan zero)', f'straight metres: {left}'))
    more = [_table('Not observed', ('quantities', 'record'), wanted)] if wanted else []
    return [_calibration_table(report['calibration']), *more]


def calibration_verdict(report: Mapping[str, Any]) -> dict[str, str]:
    """Summarise observed quantities, differences from the prior, and contradictions."""
    table = report['calibration']
    observed = sum(row['observed'] for row in table.values())
    off = {
        name: row['difference_sigmas']
        for name, row in table.items()
        if row['difference_sigmas'] is not None and abs(row['difference_sigmas']) > 3.0
    }
    residual = report.get('residual_px') or {}
    before, after = residual.get('before'), residual.get('after')
    parts = (
        f'{observed} of {len(table)} quantities observed (sweeps: {report["sweeps"]}, drives: '
        f'{report["drives"]})',
        'over 3 prior sigmas off: ' + ', '.join(off) if off else 'none is over 3 prior sigmas off',
        f'residuals in images {np.hypot(*before):.2f} px before, {np.hypot(*after):.2f} px after'
        if before and after
        else '',
        f'lost in {report["lost"]} of {report["images"]} images' if report['lost'] else '',
        'given as exact, and contradicted: ' + ', '.join(report['contradicted'])
        if report['contradicted']
        else '',
    )
    return _verdict('warning' if off or report['contradicted'] else 'good', parts)
