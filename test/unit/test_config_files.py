from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from landmark_nav.cli import learn
from landmark_nav.cli.main import main
from landmark_nav.errors import LandmarkNavError
from landmark_nav.learning.attention import AttentionConfig, FEATURES
from landmark_nav.learning.stereo import StereoConfig
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.storage.config_files import load_config

BAGS = Path(__file__).resolve().parents[2] / 'bags'


def load(tmp_path: Path, text: str) -> LocalizationConfig:
    path = tmp_path / 'config.yaml'
    path.write_text(text)
    return load_config(path, LocalizationConfig())


def test_what_is_named_changes_and_all_else_stays(tmp_path: Path) -> None:
    text = 'estimator: {tail_freedom: 4}\nobservation:\n  triangulation:\n    max_sigma_m: 1\n'
    config = load(tmp_path, text)
    assert config.estimator.tail_freedom == 4.0
    assert config.observation.triangulation.max_sigma_m == 1.0
    assert isinstance(config.observation.triangulation.max_sigma_m, float)
    assert config.odometry == LocalizationConfig().odometry
    assert config.estimator.history_s == LocalizationConfig().estimator.history_s


@pytest.mark.parametrize(
    ('section', 'former', 'name', 'value'),
    [
        ('observation.triplet', 'look_s', 'dwell_time_s', 2.0),  # keep
        ('observation.detection', 'enough', 'target_count', 7),  # keep
    ],
)
def test_a_former_name_is_taken_with_a_warning(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    section: str,
    former: str,
    name: str,
    value: float,
) -> None:
    outer, inner = section.split('.')
    config = load(tmp_path, f'{outer}: {{{inner}: {{{former}: {value}}}}}')
    assert getattr(getattr(getattr(config, outer), inner), name) == value
    assert name in caplog.text
    config = load(tmp_path, f'{outer}: {{{inner}: {{{former}: 3, {name}: {value}}}}}')
    assert getattr(getattr(getattr(config, outer), inner), name) == value


@pytest.mark.parametrize('text', ['', '# estimator: {history_s: 1}\n', 'estimator: {}\n'])
def test_where_nothing_is_named_nothing_changes(tmp_path: Path, text: str) -> None:
    assert load(tmp_path, text) == LocalizationConfig()


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('fusion: {}', "no parameter 'fusion': there are"),
        ('/**: {ros__parameters: {estimator: {}}}', 'is a file for ROS'),
        ('estimator: {tail: 4}', "estimator: no parameter 'tail'"),
        ('observation: {detection: {appearance: x}}', 'parameter appearance .* take one of'),
        ('estimator: 3', 'estimator: is 3, not a mapping'),
        ('estimator: {history_s: soon}', "estimator: history_s is 'soon': take a number"),
        ('estimator: {history_s: true}', 'history_s is True: take a number'),
        ('odometry: {along_m_per_sqrt_m: -1}', 'along_m_per_sqrt_m of .* is -1'),
        ('odometry: {estimate_odometry_bias: 1}', 'take true or false'),
        ('observation: {detection: {max_count: 2.5}}', 'take a whole number'),
        ('- fusion', 'holds no mapping'),
    ],
)
def test_what_cannot_be_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(LandmarkNavError, match=rf'config\.yaml.*{complaint}'):
        load(tmp_path, text)


def learn_command(config: Path) -> list[str]:
    room, robot = str(BAGS / 'room.yaml'), str(BAGS / 'robot.yaml')
    files = ['--room', room, '--robot', robot, '--config', str(config)]
    return ['learn', str(BAGS / 'learn'), *files, '--out', str(config.parent / 'map')]


def test_learn_takes_parameters_of_all_its_stages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    met: list[Any] = []

    def panorama_from_sweep(*arguments: Any) -> object:
        met.append(arguments[3])
        return SimpleNamespace(calibration=None)

    def learn_from_panoramas(panoramas: Any, room: Any, config: Any, log: Any) -> None:
        met.append(config)
        raise LandmarkNavError('enough')

    monkeypatch.setattr(learn, 'panorama_from_sweep', panorama_from_sweep)
    monkeypatch.setattr(learn, 'learn_from_panoramas', learn_from_panoramas)
    path = tmp_path / 'learn.yaml'
    weights = ', '.join(f'weight_{name}: {int(name == "corners")}' for name in FEATURES)
    sizes = 'size_min_px: 20, size_max_px: 64'
    path.write_text(
        f'panorama: {{blend: mean, crop_px: 350}}\nattention: {{{weights}, {sizes}}}\n'
    )
    assert main(learn_command(path)) == 1
    assert 'enough' in capsys.readouterr().err
    assert len(met) == 3
    for config in met:
        assert (config.panorama.blend, config.panorama.crop_px) == ('mean', 350)
    assert met[-1].attention.weights == AttentionConfig().alone('corners').weights
    assert met[-1].attention.sizes_px[0] == 20
    assert met[-1].attention.sizes_px[-1] == 64
    assert met[-1].stereo == StereoConfig()


def test_learn_refuses_parameters_that_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'learn.yaml'
    for text, complaint in (
        ('panorama: {blend: best}', 'panorama: parameter blend of PanoramaConfig'),
        ('attention: {size_min_px: 64}', 'size_min_px of AttentionConfig is 64, more than'),
        ('localization: {}', "no parameter 'localization': there are adjustment"),
    ):
        path.write_text(text)
        assert main(learn_command(path)) == 1
        reported = capsys.readouterr().err
        assert str(path) in reported
        assert complaint in reported
    assert [p.name for p in tmp_path.iterdir()] == ['learn.yaml']
