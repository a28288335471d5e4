"""What system tests share."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def unexamined_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """
    Leave out the search for errors of lens and mount, which is most of a short command's time.

    `recorded` is made with it, `test_diagnosis` and `test_camera_errors` test it.
    """
    for part in ('drives', 'sweeps'):
        monkeypatch.setattr(f'landmark_nav.diagnosis.{part}.camera_error_of', lambda *_: None)
