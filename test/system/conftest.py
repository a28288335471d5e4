"""What system tests share."""

from __future__ import annotations

import pytest

from landmark_nav.cli import learn


@pytest.fixture(scope='module')
def undrawn():
    """`learn` draws no figures, which take a sixth of its time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learn, '_draw', lambda *_: None)
        yield
