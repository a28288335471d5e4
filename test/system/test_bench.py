import json

import pytest

from landmark_nav.cli import bench
from landmark_nav.cli.main import main
from landmark_nav.geometry.camera import CameraModel

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
