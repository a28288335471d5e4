"""No figure of the small benchmark is over 5 % worse than the one that is kept."""

from small import recorded_figures, simulated_room, worse


def test_recorded_room(recorded):
    assert not worse('recorded', recorded_figures(recorded))


def test_simulated_room(tmp_path):
    assert not worse('simulated', simulated_room(tmp_path))
