from __future__ import annotations

from dataclasses import dataclass

import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import Config, parameter


@dataclass(frozen=True)
class Sample(Config):
    ratio: float = parameter(0.5, 'A share', minimum=0.0, maximum=1.0)
    count: int = parameter(3, 'How many', minimum=1)
    turn_rad: float = parameter(0.5, 'An angle', minimum=-3.2, maximum=3.2)
    mode: str = parameter('fast', 'What to do', choices=('fast', 'good'))
    active: bool = parameter(True, 'Whether at all')


def test_bounds_belong_to_the_range():
    assert Sample(ratio=0.0, count=1, mode='good', active=False).ratio == 0.0
    assert Sample(ratio=1.0, count=10**9).count == 10**9


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'ratio': 1.01}, 'parameter ratio of Sample is 1.01: take 0 to 1'),
        ({'ratio': float('nan')}, 'parameter ratio of Sample is nan: take a number'),
        ({'turn_rad': 90.0}, r'turn_rad of Sample is 90: take -3\.2 to 3\.2; it is in radians'),
        ({'count': -(10**40)}, r'count of Sample is -1e\+40: take 1 to any'),
        ({'count': 0}, 'parameter count of Sample is 0: take 1 to any'),
        ({'mode': 'slow'}, "parameter mode of Sample is 'slow': take one of fast, good"),
    ],
)
def test_what_is_outside_is_named(values, message):
    with pytest.raises(LandmarkNavError, match=message):
        Sample(**values)
