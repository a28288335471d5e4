"""What system tests share."""

import pytest

from landmark_nav.cli import learn


@pytest.fixture
def few(tmp_path, monkeypatch):
    """Words for `learn` where poses of sweeps are all that counts: few candidates, no figures."""
    monkeypatch.setattr(learn, '_draw', lambda *_: None)
    config = tmp_path / 'few.yaml'
    config.write_text('/**: {ros__parameters: {attention: {candidates: 40}}}\n')
    return ['--config', str(config)]
