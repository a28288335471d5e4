from collections import Counter
import json
import re
import shlex

from harness import BAGS, SETUPS
import numpy as np
import pytest

from landmark_nav.cli.main import main
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.messages.encode import camera_transform, joint_transforms
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.simulation.drive_path import PathFollower, plan_tour, plan_way
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.pan_tilt_unit import PanControl
from landmark_nav.simulation.scene import choose_sweep_places
from landmark_nav.simulation.setup_documents import robot_document, room_document
from landmark_nav.simulation.world import (
    DEFAULT_MOUNT,
    DifferentialDrive,
    drive_messages,
    DriveConfig,
    RobotWorld,
    sweep_messages,
)
from landmark_nav.storage.bags import Bag, BagWriter, read_sweeps
from landmark_nav.storage.robot_files import load_robot
from landmark_nav.storage.setup_files import load_camera, load_room
from landmark_nav.types import JointSample

SCENE = generate_scene(11)
POSE = choose_sweep_places(SCENE).poses[0]
CAMERA = CameraModel(
    160, 120, 160.0, 160.0, 80.0, 60.0, 'plumb_bob', (-0.1, 0.01, 1e-3, 1e-3, 1e-3)
)
MOUNT = PanTiltMount((0.08, 0.0, 1.1), (0.0, 0.0, 0.0), (0.04, 0.01, 0.02))


def make_world(seed=3, people=0, renderer=None):
    options = {'camera': CAMERA, 'mount': MOUNT, 'people': people, 'renderer': renderer}
    return RobotWorld(SCENE, POSE, seed, start_ns=5_000_000_000_000, **options)


@pytest.fixture(scope='module')
def world():
    return make_world()


def test_robot_does_not_drive_through_walls(world):
    world.place(POSE)
    world.command_velocity(0.8, 0.0)
    world.advance(15.0)
    assert SCENE.room.contains(world.true_pose[:2])
    assert SCENE.distance_to_obstacles(world.true_pose[:2]) >= 0.22
    assert world.truth_sample().linear_m_s == 0.0
    world.command_velocity(0.0, 0.0)


def test_sweep_and_drive_are_recorded_as_a_robot_would(world, tmp_path):
    factory = rosbag_factory()
    world.place(POSE, -np.pi)
    with BagWriter(tmp_path / 'learn') as bag:
        for topic, message, stamp in sweep_messages(world, factory, frames=24):
            bag.write(topic, message, stamp)
    (sweep,) = read_sweeps(Bag(tmp_path / 'learn'), MOUNT)
    pans = np.array([frame.pan_rad for frame in sweep.frames])
    assert pans == pytest.approx(-np.pi + np.arange(24) * np.radians(15.0), abs=2e-3)
    assert sweep.frames[0].camera == CAMERA

    path = plan_tour(SCENE, POSE[:2], 4.0, np.random.default_rng(0))
    world.place([*path[0], 0.0])
    pan_control = PanControl(SCENE, MOUNT, np.pi, np.random.default_rng(0))
    recorded = list(drive_messages(world, factory, path, pan_control, seconds=4.0))
    assert Counter(entry.topic for entry in recorded) == {
        'joint_states': 80,
        'odom': 80,
        'ground_truth/odom': 80,
        'camera/image_raw/compressed': 20,
        'camera/camera_info': 20,
    }
    stamps = np.array([entry.stamp_ns for entry in recorded])
    assert (np.diff(stamps) >= 0).all()
    truth = [
        decode.odometry(entry.message).pose_odom_base
        for entry in recorded
        if entry.topic == 'ground_truth/odom'
    ]
    assert np.linalg.norm(truth[-1][:2] - truth[0][:2]) > 0.3


def test_the_recorded_room_is_drawn_again():
    assert room_document(generate_scene(7).room) == (BAGS / 'room.yaml').read_text()
    assert robot_document(DEFAULT_MOUNT) == (BAGS / 'robot.yaml').read_text()


class TestCommand:
    @pytest.mark.parametrize('exact', [True, False])
    def test_writes_bags_and_setup(self, tmp_path, capsys, exact):
        out = tmp_path / 'run'
        words = ['--seed', '11', '--frames', '8', '--drive-seconds', '1']
        calibration = SETUPS / 'camera_quarter_vga.yaml'
        words += ['--camera', str(calibration)]
        words += ['--exact'] if exact else ['--tags', '1.0']
        assert main(['simulate', '--out', str(out), *words]) == 0
        first, learn, evaluate = map(shlex.split, capsys.readouterr().out.splitlines())
        assert first[-3:] == ['of', '4', 'walls']
        assert learn[:3] == ['landmark-nav', 'learn', str(out / 'learn')]
        assert main(evaluate[1:]) == 1
        assert 'no map there' in capsys.readouterr().err
        names = 'drive learn robot.yaml room.yaml scene.json start.json'
        assert sorted(path.name for path in out.iterdir()) == names.split()
        given = load_room(out / 'room.yaml')
        assert (given == SCENE.room) == exact
        off = np.subtract(*[[wall.start for wall in room.walls] for room in (given, SCENE.room)])
        assert np.abs(off).max() < 0.03
        mount = load_robot(out / 'robot.yaml')
        assert mount.pan_joint == 'pan_joint'
        assert (Bag(out / 'learn').start_ns - 11) % 1000 == 0, 'no other seed has its stamps'
        drive = Bag(out / 'drive')
        info = next(iter(drive.messages(['/camera/camera_info']))).message
        assert decode.camera_model(info) == load_camera(calibration)
        truth = next(iter(drive.messages(['/ground_truth/odom']))).message
        start = json.loads((out / 'start.json').read_text())['pose']
        assert decode.odometry(truth).pose_odom_base == pytest.approx(start)
        assert [float(word) for word in evaluate[-3:]] == pytest.approx(start, abs=1e-4)
        assert main(['simulate', '--out', str(out), *words]) == 1
        assert f'{out}: is there already: add --overwrite' in capsys.readouterr().err

    def test_bad_input_is_one_line_and_nothing_is_written(self, tmp_path, capsys):
        bad = tmp_path / 'room.yaml'
        bad.write_text('walls: []\n')
        out = tmp_path / 'run'
        assert main(['simulate', '--out', str(out), '--room', str(bad)]) == 1
        assert capsys.readouterr().err.count('\n') == 1
        assert not out.exists()
        robot = tmp_path / 'robot.yaml'
        robot.write_text('pan_axis: {xyz: [0.1, 0.0, 1.0]}\npan_scale: 0.01\ncamera_tilt: 0.1\n')
        assert main(['simulate', '--out', str(out), '--robot', str(robot)]) == 1
        assert {'pan_scale', 'camera_tilt'} < {*re.split('[ ,:]+', capsys.readouterr().err)}
        assert not out.exists()


DT = 1.0 / 60.0
EXACT = DriveConfig(scale_sigma=0.0, track_sigma=0.0, slip_sigma_m=0.0, encoder_step_m=0.0)


class TestDifferentialDrive:
    def test_errors_have_the_size_that_was_asked_for(self):
        # Wheels of one size and no slip: over 4 m straight on, the scale error alone remains.
        config = DriveConfig(scale_sigma=0.01, track_sigma=0.0, slip_sigma_m=0.0)
        ways = []
        for seed in range(300):
            rng = np.random.default_rng(seed)
            base = DifferentialDrive(config, (1.0, 2.0, 0.5), lambda xy: True, rng)
            base.command(0.8, 0.0)
            for _ in range(25):
                base.step(0.2)
            x, y, turn = base.pose_odom_base
            chord = np.hypot(x, y) / np.sinc(0.5 * turn / np.pi)
            ways.append(chord / np.linalg.norm(base.pose_map_base[:2] - [1.0, 2.0]) - 1.0)
        assert np.std(ways) == pytest.approx(0.01 / np.sqrt(2.0), rel=0.15)


class TestDrivePath:
    scene = generate_scene(4)

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


def test_a_camera_that_is_tilted_against_its_joint(world):
    """It shows what a level one shows with its joint tilted, and so say the transforms."""
    tilt_rad = 0.2

    def image(tilted, joint_rad):
        tilted.place(POSE, 0.3, joint_rad)
        return tilted.camera_frame().image.astype(float)

    options = {'camera': CAMERA, 'mount': MOUNT, 'renderer': world.renderer}
    fixed = image(RobotWorld(SCENE, POSE, 3, camera_tilt_rad=tilt_rad, **options), 0.0)
    by_joint, level = (image(RobotWorld(SCENE, POSE, 3, **options), t) for t in (tilt_rad, 0.0))
    assert np.abs(fixed - by_joint).mean() < 0.1 * np.abs(fixed - level).mean()
    joint = JointSample(0, 0.0, tilt_rad)
    *_, turned = joint_transforms(MOUNT, joint)
    tilted, straight = (camera_transform(MOUNT, 'camera', t) for t in (tilt_rad, 0.0))
    assert tilted.rotation == pytest.approx(turned.rotation @ straight.rotation)
    assert tilted.translation == pytest.approx(turned.rotation @ straight.translation)
