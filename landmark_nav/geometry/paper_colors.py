"""Colours of reference papers: by name, as #rrggbb, or as hsv(degrees, percent, percent)."""

from __future__ import annotations

import colorsys
import re

from landmark_nav.errors import LandmarkNavError, shown

NAMED_HUES_DEG = {
    'red': 0,
    'orange': 26,
    'yellow': 56,
    'lime': 85,
    'green': 125,
    'turquoise': 165,
    'cyan': 185,
    'blue': 230,
    'violet': 270,
    'magenta': 300,
    'pink': 335,
}

# How vivid and bright a paper is that is only named.
_NAMED_SATURATION, _NAMED_VALUE = 0.75, 0.75

# With less than that, light of another colour would change the hue at will.
_LEAST_SATURATION = 0.3

_HSV = re.compile(r'hsv\(\s*([\d.]+)\s*,\s*([\d.]+)%?\s*,\s*([\d.]+)%?\s*\)')
_HEX = re.compile(r'#([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})')


def paper_bgr(color: str) -> tuple[float, float, float]:
    """
    Blue, green and red of a paper, 0 to 255.

    Raises `LandmarkNavError`: not a colour, or one without a hue.
    """
    text = color.strip().lower()
    named, hsv, hexadecimal = NAMED_HUES_DEG.get(text), _HSV.fullmatch(text), _HEX.fullmatch(text)
    if named is not None:
        rgb = colorsys.hsv_to_rgb(named / 360.0, _NAMED_SATURATION, _NAMED_VALUE)
    elif hsv:
        h, s, v = (float(part) for part in hsv.groups())
        rgb = colorsys.hsv_to_rgb(h % 360.0 / 360.0, min(s, 100.0) / 100.0, min(v, 100.0) / 100.0)
    elif hexadecimal:
        r, g, b = (int(part, 16) / 255.0 for part in hexadecimal.groups())
        rgb = (r, g, b)
    else:
        raise LandmarkNavError(
            f'paper colour {shown(color)} is not known: take one of {", ".join(NAMED_HUES_DEG)}, '
            "'#rrggbb' in quotes, or hsv(degrees, percent, percent)"
        )
    if max(rgb) - min(rgb) < _LEAST_SATURATION * max(rgb) or max(rgb) < 0.1:
        raise LandmarkNavError(
            f'paper colour {shown(color)} is too grey or too dark to be recognised by its hue: '
            'hang a more vivid paper'
        )
    return 255.0 * rgb[2], 255.0 * rgb[1], 255.0 * rgb[0]
