"""No figure of the small benchmark is over 5 % worse than the one that is kept."""

from __future__ import annotations

from pathlib import Path

from small import recorded_figures, simulated_room, worse


def test_recorded_room(recorded: Path) -> None:
    assert not worse('recorded', recorded_figures(recorded))


def test_simulated_room(tmp_path: Path) -> None:
    assert not worse('simulated', simulated_room(tmp_path))
