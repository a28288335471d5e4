from __future__ import annotations

from pathlib import Path

import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.localization.pipeline import LocalizationConfig
from landmark_nav.storage.config_files import load_config


def load(tmp_path: Path, text: str) -> LocalizationConfig:
    path = tmp_path / 'config.yaml'
    path.write_text(text)
    return load_config(path, LocalizationConfig())


def test_what_is_named_changes_and_all_else_stays(tmp_path: Path) -> None:
    text = 'fusion: {mode: poses}\nobservation:\n  triangulation:\n    max_sigma_m: 1\n'
    config = load(tmp_path, text)
    assert config.fusion.mode == 'poses'
    assert config.observation.triangulation.max_sigma_m == 1.0
    assert isinstance(config.observation.triangulation.max_sigma_m, float)
    assert config.odometry == LocalizationConfig().odometry
    assert config.fusion.history_s == LocalizationConfig().fusion.history_s


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('fusio: {}', "no parameter 'fusio': there are"),
        ('fusion: {mod: poses}', "fusion: no parameter 'mod'"),
        ('fusion: {mode: both}', 'fusion: parameter mode .* take one of'),
        ('fusion: 3', 'fusion: is 3, not a mapping'),
        ('fusion: {history_s: soon}', "fusion: history_s is 'soon': take a float"),
        ('fusion: {history_s: true}', 'history_s is True: take a float'),
        ('odometry: {along_m_per_sqrt_m: -1}', 'along_m_per_sqrt_m of .* is -1'),
        ('odometry: {estimate_odometry_bias: 1}', 'take a bool'),
        ('health: {lost_after_rejections: 2.5}', 'take a int'),
        ('- fusion', 'holds no mapping'),
    ],
)
def test_what_cannot_be_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(LandmarkNavError, match=rf'config\.yaml.*{complaint}'):
        load(tmp_path, text)
