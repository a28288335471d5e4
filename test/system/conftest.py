"""What system tests share."""

import pytest

from landmark_nav.cli import learn


@pytest.fixture(scope='module')
def undrawn():
    """`learn` draws no figures, which take a sixth of its time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn, '_draw', lambda *_: None)
        yield


@pytest.fixture
def few(tmp_path, monkeypatch):
    """Words for `learn` where poses of sweeps are all that counts: few candidates, no figures."""
    monkeypatch.setattr(learn, '_draw', lambda *_: None)
    config = tmp_path / 'few.yaml'
    config.write_text('/**: {ros__parameters: {attention: {candidates: 40}}}\n')
    return ['--config', str(config)]
