"""Photographs of a real flat: bad matches cost landmarks, and the adjustment succeeds."""

from pathlib import Path

import numpy as np
import pytest

from landmark_nav.cli.main import main
from landmark_nav.storage.maps import load_map

pytestmark = pytest.mark.usefixtures('undrawn')
FLAT = Path(__file__).parents[3] / 'shared' / 'data' / 'flat'


@pytest.mark.skipif(not FLAT.is_dir(), reason='needs ../shared/data/flat')
def test_a_flat_is_learned_whatever_matches(tmp_path):
    wide = tmp_path / 'wide.yaml'
    # Stereo that takes any match.
    limits = 'stereo: {max_displaced_px: 8.0}\n'
    wide.write_text(limits + (FLAT / 'relaxed.yaml').read_text().split('\n', 1)[1])
    files = ['--room', str(FLAT / 'room.yaml'), '--robot', str(FLAT / 'robot.yaml')]
    out = tmp_path / 'map'
    learn = ['learn', str(FLAT / 'learn'), *files, '--config', str(wide), '--out', str(out)]
    assert main(learn) == 0
    landmarks = load_map(out).landmarks
    assert len(landmarks) >= 3
    assert all(np.linalg.eigvalsh(k.covariance)[0] > 0.0 for k in landmarks)
    assert max(float(np.abs(k.position).max()) for k in landmarks) < 10.0
