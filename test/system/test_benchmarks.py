"""Benchmarks with small inputs: their bounds hold, and no kept figure gets worse."""

from dataclasses import replace
import gzip
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


def test_a_map_is_right_where_people_are_in_most_images(tmp_path):
    (case,) = (case for case in cases(SEED) if case.name == 'people in most images')
    good, reported = judge(replace(case, camera=CAMERA, frames=16), tmp_path, SEED)
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
    # The first minutes of it.
    for path in (shared_data / 'mrclam').glob('*.dat*'):
        text = path.read_bytes()
        if path.suffix == '.gz':
            lines = gzip.decompress(text).splitlines(keepends=True)
            begin = float(next(line for line in lines if line[:1] != b'#').split()[0])
            text = b''.join(k for k in lines if k[:1] == b'#' or float(k.split()[0]) < begin + 400)
        (tmp_path / path.name.removesuffix('.gz')).write_bytes(text)
    report = driven(3, tmp_path, tmp_path)
    assert meets_bounds(report, 3)
    assert report['odometry']['position_rmse_m'] > 5.0 * report['fused']['position_rmse_m']
