"""Keys of `landmark-nav drive`."""

import pytest

from landmark_nav.cli.drive import Keys


@pytest.mark.parametrize(
    ('typed', 'velocity'),
    [
        ('w', (0.2, 0.0)),
        ('s', (-0.2, 0.0)),
        ('a', (0.0, 0.5)),
        ('\x1b[A', (0.2, 0.0)),
        ('\x1b[C', (0.0, -0.5)),
        ('q', (0.2, 0.5)),
        ('w ', (0.0, 0.0)),
        ('W', (0.2, 0.0)),
        ('+w', (0.25, 0.0)),
        ('\x00\udcff\x1b', (0.0, 0.0)),
    ],
)
def test_a_key_moves_the_robot(typed, velocity):
    keys = Keys(0.2, 0.5)
    keys.press(typed, 10.0)
    assert keys.velocity(10.1) == pytest.approx(velocity)


def test_the_robot_stops_without_keys():
    keys = Keys(0.2, 0.5)
    assert keys.velocity(0.0) == (0.0, 0.0)
    keys.press('w', 0.0)
    keys.press('w', 0.7)
    assert keys.velocity(1.4) == pytest.approx((0.2, 0.0))
    assert keys.velocity(2.0) == (0.0, 0.0)
    keys.press('wx', 2.0)
    assert keys.ended
    assert keys.velocity(2.1) == (0.0, 0.0)
