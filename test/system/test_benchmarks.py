"""Benchmarks with small inputs: their bounds hold, and no kept figure gets worse."""

from dataclasses import replace
import json

from bad_sweeps import cases, judge
from mrclam import driven, meets_bounds
import pytest
from small import simulated_room, worse

from landmark_nav.cli import bench
from landmark_nav.cli.main import main
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


def test_simulated_room(tmp_path):
    assert not worse('simulated', simulated_room(tmp_path))


# A quarter of the pixels, and of the time.
SMALL = CameraModel(256, 256, 220.0, 220.0, 127.5, 127.5)


def test_bench_times_every_stage_beside_a_reference(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, 'CAMERA', SMALL)
    figures = tmp_path / 'bench.json'
    assert main(['bench', '--repeats', '1', '--json', str(figures)]) == 0
    document = json.loads(figures.read_text(encoding='utf-8'))
    names = ' '.join(stage['stage'] for stage in document['stages'])
    for stage in (
        'capture', 'panorama', 'calibration', 'papers', 'attention', 'stereo', 'adjustment',
        'election', 'plan of', 'triplet', 'detection', 'triangulation', 'fusion',
    ):  # fmt: skip
        assert stage in names
    for stage in document['stages']:
        assert stage['ratio'] == pytest.approx(stage['seconds'] / stage['reference_seconds'])
    (update,) = (stage for stage in document['stages'] if 'update' in stage['stage'])
    assert update['p95_seconds'] >= update['seconds']
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(document['stages'])


def test_bearings_keep_commanded_odometry_on_the_floor(shared_data, tmp_path):
    report = driven(3, shared_data / 'mrclam', tmp_path)
    assert meets_bounds(report, 3)
    assert report['odometry']['position_rmse_m'] > 5.0 * report['fused']['position_rmse_m']
