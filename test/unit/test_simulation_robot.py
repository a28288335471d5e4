import numpy as np
import pytest

from landmark_nav.geometry.camera import CameraModel
from landmark_nav.simulation.drive_path import PathFollower, plan_tour, plan_way
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.pan_tilt_unit import PanTiltConfig, PanTiltUnit
from landmark_nav.simulation.renderer import CameraEffects, CameraEffectsConfig
from landmark_nav.simulation.world import DifferentialDrive, DriveConfig

DT = 1.0 / 60.0
CAMERA = CameraModel(128, 96, 100.0, 100.0, 63.5, 47.5)
EXACT = DriveConfig(scale_sigma=0.0, track_sigma=0.0, slip_sigma_m=0.0, encoder_step_m=0.0)


def run_unit(unit, seconds):
    angles = []
    for _ in range(round(seconds / DT)):
        unit.step(DT)
        angles.append(unit.angles_rad)
    return np.array(angles)


class TestPanTiltUnit:
    def test_arrives_and_settles_after_some_swinging(self):
        unit = PanTiltUnit(PanTiltConfig())
        unit.command(1.5, -0.2)
        angles = run_unit(unit, 3.0)
        assert unit.settled
        assert angles[-1] == pytest.approx([1.5, -0.2], abs=1e-3)
        # The head swings past its goal, by little.
        assert 1.501 < angles[:, 0].max() < 1.6

    def test_keeps_its_limits(self):
        config = PanTiltConfig(max_rate_rad_s=0.8, max_acceleration_rad_s2=2.0)
        unit = PanTiltUnit(config)
        unit.command(9.0, 9.0)
        angles = run_unit(unit, 8.0)
        rate = np.gradient(angles[:, 0], DT)
        assert angles[-1] == pytest.approx([config.pan_limit_rad, config.tilt_limit_rad], abs=1e-3)
        assert rate.max() < 1.15 * config.max_rate_rad_s
        # From rest to full rate takes rate / acceleration.
        assert rate[: int(0.2 / DT)].max() < 0.75 * config.max_rate_rad_s


def drive(config, seed=0, free=lambda xy: True):
    return DifferentialDrive(config, (1.0, 2.0, 0.5), free, np.random.default_rng(seed))


class TestDifferentialDrive:
    def test_errors_have_the_size_that_was_asked_for(self):
        # Wheels of one size and no slip: over 4 m straight on, the scale error alone remains.
        config = DriveConfig(scale_sigma=0.01, track_sigma=0.0, slip_sigma_m=0.0)
        ways = []
        for seed in range(300):
            base = drive(config, seed)
            base.command(0.8, 0.0)
            for _ in range(25):
                base.step(0.2)
            x, y, turn = base.pose_odom_base
            chord = np.hypot(x, y) / np.sinc(0.5 * turn / np.pi)
            ways.append(chord / np.linalg.norm(base.pose_map_base[:2] - [1.0, 2.0]) - 1.0)
        assert np.std(ways) == pytest.approx(0.01 / np.sqrt(2.0), rel=0.15)

    def test_stops_before_obstacles_but_can_turn_there(self):
        base = drive(EXACT, free=lambda xy: xy[0] < 1.5)
        base.command(0.5, 0.0)
        for _ in range(300):
            base.step(DT)
        assert 1.4 < base.pose_map_base[0] < 1.5
        base.command(0.5, 1.0)
        for _ in range(240):
            base.step(DT)
        assert base.pose_map_base[2] != pytest.approx(0.5, abs=0.5)
        assert base.pose_map_base[0] < 1.5


class TestCameraEffects:
    def test_a_lens_mixes_light(self):
        config = CameraEffectsConfig(
            vignetting=0.0, auto_exposure=0.0, blur_sigma_px=1.0, read_noise=0.0, shot_noise=0.0
        )
        stripes = np.tile(np.array([0, 255], np.uint8), (96, 64))
        effects = CameraEffects(CAMERA, config, np.random.default_rng(0))
        mixed = effects.apply(np.repeat(stripes[..., None], 3, axis=2))
        # Half the light is a value of 188 in sRGB.
        assert mixed[10:-10, 10:-10].mean() == pytest.approx(188.0, abs=1.0)


class TestDrivePath:
    scene = generate_scene(4)

    def test_tour_keeps_clear_and_is_long_enough(self):
        start = np.array([3.5, 2.5])
        path = plan_tour(self.scene, start, 12.0, np.random.default_rng(0))
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() > 10.0
        assert self.scene.distance_to_obstacles(path[20:]).min() > 0.3

    def test_follower_keeps_to_the_path(self):
        path = plan_tour(self.scene, (3.5, 2.5), 8.0, np.random.default_rng(1))
        base = DifferentialDrive(EXACT, (*path[0], 0.0), lambda xy: True, np.random.default_rng(0))
        follower = PathFollower(path, 0.4)
        off = []
        for _ in range(60 * 90):
            if follower.finished:
                break
            base.command(*follower.command(base.pose_map_base))
            base.step(DT)
            off.append(np.linalg.norm(path - base.pose_map_base[:2], axis=1).min())
        assert follower.finished
        assert max(off) < 0.25
        assert np.linalg.norm(base.pose_map_base[:2] - path[-1]) < 0.2

    def test_way_leads_from_place_to_place(self):
        way = plan_way(self.scene, (3.5, 2.5), (5.5, 3.5))
        assert way[0] == pytest.approx([3.5, 2.5], abs=0.1)
        assert way[-1] == pytest.approx([5.5, 3.5], abs=0.1)
