"""What system tests share."""

import pytest


@pytest.fixture(scope='session')
def fewer(tmp_path_factory):
    """Words for commands that learn, by which they look at few candidates."""
    config = tmp_path_factory.mktemp('few') / 'few.yaml'
    config.write_text('/**: {ros__parameters: {attention: {candidates: 40}}}\n')
    return ['--config', str(config)]


@pytest.fixture
def few(fewer, monkeypatch):
    """The same for `learn` where poses of sweeps are all that counts: it draws nothing."""
    monkeypatch.setattr('landmark_nav.cli.learn._draw', lambda *_: None)
    return fewer
