"""A run on one page: figures and numbers in a single HTML file."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

__all__ = ['html_report']

_STYLE = (
    'body{font-family:sans-serif;max-width:62rem;margin:2rem auto;color:#222;line-height:1.4}'
    'table{border-collapse:collapse;margin:1rem 0}'
    'td,th{padding:.25rem .9rem;border-bottom:1px solid #ddd;text-align:right}'
    'td:first-child,th:first-child{text-align:left}img{max-width:100%}'
)

_ROWS = {
    'position RMSE [cm]': ('position_rmse_m', 100.0),
    'position median [cm]': ('position_median_m', 100.0),
    'position 95 % [cm]': ('position_p95_m', 100.0),
    'position maximum [cm]': ('position_max_m', 100.0),
    'heading RMSE [deg]': ('heading_rmse_deg', 1.0),
    'heading 95 % [deg]': ('heading_p95_deg', 1.0),
}

_ESTIMATES = ('fused', 'triangulation', 'odometry', 'smoothed')


def html_report(title: str, report: Mapping[str, Any], figures: Mapping[str, Path]) -> str:
    """
    Build the page; it needs no other file.

    Parameters
    ----------
    title : str
        Of the page.
    report : mapping
        As `landmark_nav.evaluation.run_report.run_report` makes it.
    figures : mapping of str to Path
        Captions and PNG files.

    """
    estimates = [name for name in _ESTIMATES if name in report]
    head = ''.join(f'<th>{name}</th>' for name in ('error', *estimates))
    body = ''.join(
        f'<tr><td>{label}</td>'
        + ''.join(f'<td>{_scaled(report[name][key], factor)}</td>' for name in estimates)
        + '</tr>'
        for label, (key, factor) in _ROWS.items()
    )
    rest = {
        'pictures': report['frames'],
        'triangulated poses': report['fixes'],
        'availability': _scaled(report['availability'], 1.0),
        'landmarks in the map': report['landmarks'],
        'NEES, mean (3 is ideal)': _scaled(report['nees']['mean'], 1.0),
        'NEES, share below its 95 % bound': _scaled(report['nees']['inside_95'], 1.0),
        'RMSE over Cramer-Rao bound': _scaled(report['crlb_ratio'], 1.0),
        'update, median and 95 % [ms]': f'{_scaled(report["update_ms"]["median"], 1.0)}, '
        f'{_scaled(report["update_ms"]["p95"], 1.0)}',
        'times faster than real time': _scaled(report['realtime_factor'], 1.0),
        'result hash': report['result_hash'][:16],
    }
    others = ''.join(
        f'<tr><td>{escape(name)}</td><td>{escape(str(value))}</td></tr>'
        for name, value in rest.items()
    )
    spells = ''.join(
        f'<tr><td>{escape(spell["status"])}</td><td>{spell["from_s"]:.1f}</td>'
        f'<td>{spell["to_s"]:.1f}</td><td style="text-align:left">{escape(spell["reason"])}</td>'
        '</tr>'
        for spell in report['spells']
    )
    if spells:
        head_of_spells = '<th>not tracking</th><th>from [s]</th><th>to [s]</th><th>reason</th>'
        others += f'</table><table><tr>{head_of_spells}</tr>{spells}'
    pictures = ''.join(
        f'<h2>{escape(caption)}</h2><img alt="{escape(caption)}" '
        f'src="data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}">'
        for caption, path in figures.items()
    )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<style>{_STYLE}</style><h1>{escape(title)}</h1>'
        '<p>Errors are absolute in map, never aligned, at the stamps of the pictures.</p>'
        f'<table><tr>{head}</tr>{body}</table><table>{others}</table>{pictures}</html>\n'
    )


def _scaled(value: float | None, factor: float) -> str:
    return '-' if value is None else f'{factor * value:.3g}'
