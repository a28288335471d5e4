"""A run on one page: figures and numbers in a single HTML file."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from typing import Any

__all__ = ['ESTIMATES', 'cell', 'html_report', 'nees_range']

_STYLE = (
    ':root{color-scheme:light dark}'
    'body{font-family:sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;line-height:1.4}'
    'table{border-collapse:collapse;display:block;overflow-x:auto;margin:1rem 0}'
    'td,th{padding:.25rem .7rem;border-bottom:1px solid #8886;text-align:right}'
    'td{font-variant-numeric:tabular-nums}'
    'td:first-child,th:first-child,.left{text-align:left}'
    'img{max-width:100%;background:#fff;cursor:zoom-in}.whole{max-width:none;cursor:zoom-out}'
)

_ROWS = {
    'position RMSE [cm]': ('position_rmse_m', 100.0, 2),
    'position median [cm]': ('position_median_m', 100.0, 2),
    'position 95 % [cm]': ('position_p95_m', 100.0, 2),
    'position maximum [cm]': ('position_max_m', 100.0, 2),
    'heading RMSE [deg]': ('heading_rmse_deg', 1.0, 3),
    'heading 95 % [deg]': ('heading_p95_deg', 1.0, 3),
}

ESTIMATES = ('fused', 'triangulation', 'odometry', 'smoothed')


def html_report(title: str, report: Mapping[str, Any], figures: Mapping[str, bytes]) -> str:
    """
    Build the page; it needs no other file.

    Parameters
    ----------
    title : str
        Of the page.
    report : mapping
        As `landmark_nav.evaluation.run_report` makes it: of a run, or of its poses alone.
    figures : mapping of str to bytes
        Captions and PNG data.

    """
    estimates = [name for name in ESTIMATES if name in report]
    head = ''.join(f'<th>{name}</th>' for name in ('error', *estimates))
    body = ''.join(
        f'<tr><td>{label}</td>'
        + ''.join(f'<td>{cell(report[name][key], factor, digits)}</td>' for name in estimates)
        + '</tr>'
        for label, (key, factor, digits) in _ROWS.items()
    )
    nees = report['nees']
    rest = {
        'images': report['frames'],
        'triangulated poses': report['fixes'],
        'availability': cell(report['availability'], 1.0, 3),
        'landmarks in the map': report['landmarks'],
        'claimed sigma, median [cm]': cell(report['claimed']['position_median_m'], 100.0, 2),
        f'NEES, mean (3 is ideal{nees_range(nees["interval_95"])})': cell(nees['mean'], 1.0, 2),
        'NEES, share within 95 % [%]': cell(nees['inside_95'], 100.0, 1),
        'images over 5 sigma off, not reported': cell(report['silently_wrong'], 1, 0),
        **(_of_replay(report) if 'crlb_ratio' in report else {}),
    }
    others = ''.join(
        f'<tr><td>{escape(name)}</td><td>{escape(str(value))}</td></tr>'
        for name, value in rest.items()
    )
    spells = ''.join(
        f'<tr><td>{escape(spell["status"])}</td><td>{spell["from_s"]:.1f}</td>'
        f'<td>{spell["to_s"]:.1f}</td><td class="left">{escape(spell["reason"])}</td>'
        '</tr>'
        for spell in report.get('spells', ())
    )
    if spells:
        head_of_spells = '<th>not tracking</th><th>from [s]</th><th>to [s]</th>'
        head_of_spells += '<th class="left">reason</th>'
        others += f'</table><table><tr>{head_of_spells}</tr>{spells}'
    text = report.get('warning')
    warning = f'<p><strong>Warning: {escape(text)}</strong></p>' if text else ''
    images = ''.join(
        f'<h2>{escape(caption)}</h2><img alt="{escape(caption)}" title="click for full size" '
        'onclick="this.classList.toggle(\'whole\')" '
        f'src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        for caption, png in figures.items()
    )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{escape(title)}</title>'
        f'<style>{_STYLE}</style><h1>{escape(title)}</h1>'
        f'<p>Errors are {_frame(report)}, at the stamps of the images.</p>'
        f'{warning}<table><tr>{head}</tr>{body}</table><table>{others}</table>{images}</html>\n'
    )


def _frame(report: Mapping[str, Any]) -> str:
    """Name what errors are measured against."""
    if report.get('aligned'):
        return 'those after one rigid transformation, as the map has a frame of its own'
    return 'absolute in map, never aligned'


def _of_replay(report: Mapping[str, Any]) -> dict[str, str]:
    found, times = report['found'], report['update_ms']
    return {
        'RMSE over Cramér-Rao bound': cell(report['crlb_ratio'], 1.0, 2),
        'place': 'given' if found is None else f'found after {found["after_s"]:.1f} s',
        'update, median [ms]': cell(times['median'], 1.0, 1),
        'update, 95 % within [ms]': cell(times['p95'], 1.0, 1),
        'times real time': cell(report['realtime_factor'], 1.0, 1),
        'result hash': report['result_hash'][:16],
    }


def nees_range(interval: list[float] | None) -> str:
    """Give the bounds between which the mean NEES is consistent, if that is known."""
    return f', {interval[0]:.2f} to {interval[1]:.2f} is consistent' if interval else ''


def cell(value: float | None, factor: float, digits: int) -> str:
    """Write a figure in another unit, or a dash where there is none."""
    return '-' if value is None else f'{factor * value:.{digits}f}'
