"""What system tests share."""

import pytest


@pytest.fixture(scope='module')
def few(undrawn, tmp_path_factory):
    """Words for `learn` where poses of sweeps are all that counts: few candidates, no figures."""
    config = tmp_path_factory.mktemp('few') / 'few.yaml'
    config.write_text('/**: {ros__parameters: {attention: {candidates: 40}}}\n')
    return ['--config', str(config)]
