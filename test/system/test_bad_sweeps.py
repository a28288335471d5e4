"""Sweeps with faults through `learn`: some cases of `make bad-sweeps` with small images."""

from dataclasses import replace

from bad_sweeps import cases, judge
import pytest

from landmark_nav.geometry.camera import CameraModel

pytestmark = pytest.mark.usefixtures('undrawn')
SEED = 5100
# A small image with a wide view: few make a turn.
CAMERA = CameraModel(300, 300, 230.0, 230.0, 149.5, 149.5)


@pytest.fixture(scope='module')
def known():
    return {case.name: replace(case, camera=CAMERA, frames=16) for case in cases(SEED)}


@pytest.mark.parametrize(
    'name', ['an overexposed window', 'upside down, as given', 'people in most images']
)
def test_a_map_is_right_or_the_refusal_clear(known, name, tmp_path):
    good, reported = judge(known[name], tmp_path, SEED)
    assert good, reported
