"""Sweeps with faults through `learn`: some cases of `make bad-sweeps` with small images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bad_sweeps import Case, cases, judge
import pytest

from landmark_nav.geometry.camera import CameraModel

pytestmark = pytest.mark.usefixtures('undrawn')
SEED = 5100
# A small image with a wide view: few make a turn.
CAMERA = CameraModel(300, 300, 230.0, 230.0, 149.5, 149.5)


@pytest.fixture(scope='module')
def known() -> dict[str, Case]:
    return {case.name: replace(case, camera=CAMERA, frames=16) for case in cases(SEED)}


@pytest.mark.parametrize(
    'name',
    [
        'an overexposed window',
        'upside down, as given',
        'people in most images',
    ],
)
def test_a_map_is_right_or_the_refusal_clear(
    known: dict[str, Case], name: str, tmp_path: Path
) -> None:
    good, reported = judge(known[name], tmp_path, SEED)
    assert good, reported
