"""
Sweeps that went wrong, through ``landmark-nav learn``: a map that is right, or a clear refusal.

``python test/benchmarks bad_sweeps`` simulates a room, takes sweeps in it under bad conditions,
and learns from each pair of them. It exits with 1 if a map holds a landmark that lies farther
from the truth than its covariance allows, if the covariances of a map are too small as a whole,
or if something is refused for another reason than its own, or not reported.
``test/system/test_benchmarks.py`` runs some.

``python test/benchmarks bad_sweeps --errors FOLDER`` takes the recorded sweeps of a folder with
``learn``, ``room.yaml`` and ``robot.yaml`` (``bags``), gives them with an error each, and prints
what is said of it. It exits with 1 if a cause is not named.
"""

import argparse
import contextlib
import copy
from dataclasses import dataclass, replace
from functools import lru_cache
import io
import logging
from pathlib import Path
import re
import tempfile
from unittest.mock import patch

import cv2
from landmarks import TrueWalls
import numpy as np

from landmark_nav.cli.main import main as landmark_nav
from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.renderer import Renderer
from landmark_nav.simulation.scene import choose_sweep_places, Lamp, Scene
from landmark_nav.simulation.setup_documents import robot_document, room_document
from landmark_nav.simulation.world import DEFAULT_CAMERA, DEFAULT_MOUNT, RobotWorld, sweep_messages
from landmark_nav.storage.bags import Bag, BagWriter, read_sweeps
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_robot
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import FloatArray, PoseEstimate, Sweep

# A landmark is wrong if it lies farther off than so many of its standard deviations, and this.
MAX_SIGMAS, MAX_ERROR_M = 5.0, 0.03
# Landmarks of a map share their error, so the mean of their NEES spreads no less than a single
# chi-square of three degrees of freedom: 99 % of consistent maps stay below.
MAX_NEES = 11.3
LEAST_LANDMARKS = 12

# Most cases are of one scene; to draw its textures takes seconds.
_renderer, _true_walls = lru_cache(maxsize=4)(Renderer), lru_cache(maxsize=4)(TrueWalls)


@dataclass(frozen=True)
class Case:
    """Sweeps of (scene, pose), what the robot is given, and what should come of it."""

    name: str
    sweeps: tuple[tuple[Scene, FloatArray], ...]
    refusal: str = ''
    true_mount: PanTiltMount = DEFAULT_MOUNT
    given_mount: PanTiltMount = DEFAULT_MOUNT
    given_room: Room | None = None
    tilt_rad: float = 0.0
    people: int = 0
    few: bool = False  # a small map will do as well as the refusal
    hidden: bool = False  # so may papers be: a full map will do as well as the refusal
    camera: CameraModel = DEFAULT_CAMERA
    frames: int = 48


class TiltedWorld(RobotWorld):
    """A world whose camera keeps a tilt."""

    tilt_rad = 0.0

    def command_pan(self, pan_rad, tilt_rad=0.0):
        """Turn, tilted."""
        super().command_pan(pan_rad, tilt_rad + self.tilt_rad)


def moved_wall(room, k, shift_m, turn_rad=0.0):
    """Room whose wall k stands `shift_m` farther in, and is turned about its middle."""
    start, end = (np.array(point) for point in (room.walls[k].start, room.walls[k].end))
    middle, along = 0.5 * (start + end), end - start
    normal = np.array(room.walls[k].normal[:2])
    along = np.cos(turn_rad) * along + np.sin(turn_rad) * normal * np.linalg.norm(along)
    middle = middle + shift_m * normal

    def met_by(other):
        side = np.subtract(other.end, other.start)
        share = np.linalg.solve(np.stack([along, -side], 1), np.subtract(other.start, middle))[0]
        x, y = middle + share * along
        return float(x), float(y)

    walls, before, after = list(room.walls), k - 1, (k + 1) % len(room.walls)
    first, last = met_by(walls[before]), met_by(walls[after])
    walls[before] = replace(walls[before], end=first)
    walls[k] = replace(walls[k], start=first, end=last)
    walls[after] = replace(walls[after], start=last)
    return replace(room, walls=tuple(walls))


def cases(seed):
    """All that may go wrong in one room."""
    scene = generate_scene(seed)
    places = choose_sweep_places(scene)
    assert places is not None
    here, there = places.poses
    papers = scene.room.papers

    def lit(change):
        return replace(scene, lamps=tuple(change(k, lamp) for k, lamp in enumerate(scene.lamps)))

    dim = lit(lambda k, lamp: replace(lamp, power=(0.1 if k == 0 else 0.7) * lamp.power))
    warm = lit(lambda k, lamp: replace(lamp, tint=(0.6, 0.9, 1.2)))
    x, y, z = papers[0].center
    paper_wall = int(scene.room.nearest_wall(np.array([x, y])))
    inward = scene.room.walls[paper_wall].normal
    window = Lamp((x + 0.2 * inward[0], y + 0.2 * inward[1], z + 0.5), (0.0, 0.0), 2.0)
    glare = replace(scene, lamps=(*scene.lamps, window))
    other = generate_scene(seed + 1000, scene.room)
    swapped = replace(
        scene.room,
        papers=(
            replace(papers[0], color=papers[1].color),
            replace(papers[1], color=papers[0].color),
            *papers[2:],
        ),
    )
    lengths = [0.0 if k == paper_wall else wall.length for k, wall in enumerate(scene.room.walls)]
    k = int(np.argmax(lengths))
    wall = scene.room.walls[k]
    bare = replace(scene.room, papers=papers[:2])
    hidden = replace(scene, room=bare)
    over = replace(DEFAULT_MOUNT, axis_rpy=(np.pi, 0.0, 0.0))
    rolled = replace(DEFAULT_MOUNT, camera_roll_rad=np.pi)
    camera_tilt = replace(DEFAULT_MOUNT, axis_rpy=(0.05, -0.04, 0.0))
    off = replace(DEFAULT_MOUNT, optical_center_offset=(0.06, 0.0, 0.03))
    both = ((scene, here), (scene, there))
    nearly = np.add(here, [0.03, 0.02, 1.0])
    return [
        Case('as usual', both),
        Case('a lamp switched between', ((scene, here), (dim, there))),
        Case('warm light, then usual', ((warm, here), (scene, there))),
        Case('an overexposed window', ((glare, here), (glare, there))),
        Case('upside down, as given', both, true_mount=over, given_mount=over),
        Case('upside down, not given', both, 'pan unit is mounted the other', true_mount=over),
        Case('camera alone upside down, as given', both, true_mount=rolled, given_mount=rolled),
        Case('camera alone upside down, not reported', both, 'camera_roll: 3.14',
             true_mount=rolled),
        Case('tilted, as given', both, true_mount=camera_tilt, given_mount=camera_tilt),
        Case('tilted, not reported', both, 'axis_roll.*axis_pitch', true_mount=camera_tilt),
        Case('tilted by its joint, off the axis', both, '', off, off, tilt_rad=0.12),
        Case('from the same place', ((scene, here), (scene, nearly)), 'from one place'),
        Case('other things on the walls', ((scene, here), (other, there)), 'found again|elected',
             few=True),
        Case('people in most images', both, 'hides the papers|uncover the papers', people=8,
             hidden=True),
        Case('a wall 5 cm off', both,
             f'do not fit.*{wall.id} has|may be wrong.*cm behind {wall.id}',
             given_room=moved_wall(scene.room, k, 0.05)),
        Case('a wall turned by 3 deg', both, f'do not fit.*{wall.id} is turned',
             given_room=moved_wall(scene.room, k, 0.0, np.radians(3.0))),
        Case('one sweep only', ((scene, here),), 'needs two panoramas'),
        Case('papers swapped', both, 'seem swapped', given_room=swapped),
        Case('a paper hidden', ((hidden, here), (scene, there)), papers[2].color,
             given_room=scene.room),
    ]  # fmt: skip


def record(case, folder, seed):
    """Write the bag of sweeps and what the robot is given."""
    factory = rosbag_factory()
    start_ns = 1_000_000_000_000
    with BagWriter(folder / 'learn') as bag:
        for scene, pose in case.sweeps:
            world = TiltedWorld(
                scene, pose, seed, camera=case.camera, mount=case.true_mount, people=case.people,
                start_ns=start_ns, renderer=_renderer(scene, case.camera),
            )  # fmt: skip
            world.tilt_rad = case.tilt_rad
            world.place(pose, -np.pi, case.tilt_rad)
            for message in sweep_messages(world, factory, frames=case.frames):
                bag.write(message.topic, message.message, message.stamp_ns)
            start_ns = world.stamp_ns + 5_000_000_000
    room = case.given_room or case.sweeps[0][0].room
    (folder / 'room.yaml').write_text(room_document(room), encoding='utf-8')
    (folder / 'robot.yaml').write_text(robot_document(case.given_mount), encoding='utf-8')


def learn(folder):
    """Refusal of the command, or nothing; and what it warned of."""
    output, warned = io.StringIO(), io.StringIO()
    handler = logging.StreamHandler(warned)
    logging.getLogger().addHandler(handler)
    with contextlib.redirect_stderr(output), contextlib.redirect_stdout(io.StringIO()):
        status = landmark_nav(
            [
                'learn', str(folder / 'learn'), '--room', str(folder / 'room.yaml'),
                '--robot', str(folder / 'robot.yaml'), '--out', str(folder / 'map'),
            ]
        )  # fmt: skip
    logging.getLogger().removeHandler(handler)
    lines = [line for line in output.getvalue().strip().splitlines() if 'refused' not in line]
    return lines[-1] if status else '', warned.getvalue()


def judge(case, folder, seed):
    """Whether it went as it should, and what came of it."""
    record(case, folder, seed)
    refusal, warned = learn(folder)
    if refusal:
        fine = bool(case.refusal) and re.search(case.refusal, refusal) is not None
        return fine, f'refused: {refusal}'
    landmarks = load_map(folder / 'map').landmarks
    walls = _true_walls(case.sweeps[0][0])
    pairs = [(k, walls.place(k)) for k in landmarks]
    errors = [(k.position - place, k) for k, place in pairs if place is not None]
    size = np.array([np.linalg.norm(error) for error, _ in errors])
    sigmas = np.array(
        [np.sqrt(error @ np.linalg.solve(k.covariance, error) / 3.0) for error, k in errors]
    )
    nees = 3.0 * float(np.mean(sigmas**2))
    wrong = int(np.sum((sigmas > MAX_SIGMAS) & (size > MAX_ERROR_M)))
    output = (
        f'{len(landmarks)} landmarks, {len(errors)} found in truth: '
        f'median {1e3 * np.median(size):.1f} mm, 95 % {1e3 * np.percentile(size, 95):.1f} mm, '
        f'NEES {nees:.1f}, {wrong} wrong'
    )
    if warned:
        output += f'; {" ".join(warned.split())}'
    # A map that is right all the same will do if what is wrong was reported.
    fine = case.hidden or not case.refusal or re.search(case.refusal, warned) is not None
    many = fine and len(landmarks) >= LEAST_LANDMARKS
    return not wrong and nees < MAX_NEES and (case.few or many), output


@dataclass(frozen=True)
class Given:
    """What learning is given: room, mount, sweeps."""

    room: Room
    mount: PanTiltMount
    sweeps: tuple[Sweep, ...]

    def paper(self, k, **changes):
        """The same with values of one paper changed."""
        papers = list(self.room.papers)
        papers[k] = replace(papers[k], **changes)
        return replace(self, room=replace(self.room, papers=tuple(papers)))

    def hung(self, k, left_m=0.0, up_m=0.0, in_m=0.0):
        """The same with a paper given elsewhere: left along its wall, up, into the room."""
        paper = self.room.papers[k]
        wall = self.room.walls[int(self.room.nearest_wall(np.array(paper.center[:2])))]
        x, y = np.array(paper.center[:2]) + left_m * wall.along + in_m * wall.normal[:2]
        return self.paper(k, center=(float(x), float(y), paper.center[2] + up_m))

    def sized(self, k, scale):
        """The same with a paper given larger."""
        paper = self.room.papers[k]
        return self.paper(k, width=scale * paper.width, height=scale * paper.height)

    def redrawn(self, axes=(1.0, 1.0, 1.0), sheets=1.0):
        """The plan with its axes scaled, mirrored, and its sheets; walls go round as before."""
        x, y, z = axes
        walls = tuple(
            replace(
                wall,
                start=(x * wall.start[0], y * wall.start[1]),
                end=(x * wall.end[0], y * wall.end[1]),
                height=z * wall.height,
            )
            for wall in self.room.walls
        )
        if x * y < 0.0:
            walls = tuple(replace(wall, start=wall.end, end=wall.start) for wall in walls[::-1])
        papers = tuple(
            replace(
                paper,
                center=tuple(np.multiply(paper.center, axes).tolist()),
                width=sheets * paper.width,
                height=sheets * paper.height,
            )
            for paper in self.room.papers
        )
        return replace(self, room=replace(self.room, walls=walls, papers=papers))

    def frames(self, change):
        """The same with all frames changed."""
        sweeps = (replace(s, frames=tuple(map(change, s.frames))) for s in self.sweeps)
        return replace(self, sweeps=tuple(sweeps))

    def pans(self, change):
        """The same with other pan angles."""
        return self.frames(lambda frame: replace(frame, pan_rad=float(change(frame.pan_rad))))

    def focal(self, scale):
        """The same with another focal length."""

        def scaled(frame):
            camera = frame.camera
            camera = replace(camera, fx=scale * camera.fx, fy=scale * camera.fy)
            return replace(frame, camera=camera)

        return self.frames(scaled)

    def posed(self, poses, covariance):
        """The same with ``sweep/pose``."""
        return replace(
            self,
            sweeps=tuple(
                replace(sweep, pose_map_base=PoseEstimate(sweep.stamp_ns, pose, covariance))
                for sweep, pose in zip(self.sweeps, poses, strict=True)
            ),
        )


def errors_of(given, poses):
    """Names of errors, what is given with them, and what must be said; `poses` are true."""
    papers, mount = given.room.papers, given.mount
    colors = [paper.color for paper in papers]
    middle = int(np.argsort([np.sum(np.square(p.center)) for p in papers])[len(papers) // 2])
    color, other = colors[middle], colors[middle - 1]
    hung = f'{color} paper hangs'
    yield 'nothing', given, '^$'
    for cm in (2, 5, 10, 20):
        for side, word in ((1, 'right'), (-1, 'left')):
            wrong = given.hung(middle, left_m=0.01 * side * cm)
            yield f'{color} {cm} cm along, to the {word}', wrong, f'{hung} .*{word}'
    for cm in (5, 10, 20):
        for side, word in ((1, 'lower'), (-1, 'higher')):
            wrong = given.hung(middle, up_m=0.01 * side * cm)
            yield f'{color} {cm} cm {word}', wrong, f'{hung} .*{word}'
    yield f'two {other} papers', given.paper(middle, color=other), 'of another colour'
    swapped = given.paper(middle, color=other).paper(middle - 1, color=color)
    yield 'colours swapped', swapped, 'seem swapped'
    yield 'pan reversed', given.pans(lambda pan: -pan), 'sign of the pan is reversed'
    yield 'K of half the image', given.focal(0.5), 'camera_info gives a focal length'
    yield 'K of twice the image', given.focal(2.0), 'camera_info gives a focal length'
    yield 'pan stays 0', given.pans(lambda pan: 0.0), 'pan does not turn'
    yield 'pan of two values', given.pans(lambda pan: float(pan > 0.0)), 'pan does not turn'
    yield 'pan within 5 deg', given.pans(lambda pan: pan / 72.0), 'pan does not turn'
    for name, covariance, text in (
        ('1e100', 1e100 * np.eye(3), 'standard deviations'),
        ('-1', -np.eye(3), 'a negative variance'),
        ('NaN', np.nan * np.eye(3), 'a covariance that is not a number'),
    ):
        wrong = given.posed(poses, covariance)
        yield f'sweep/pose with covariance {name}', wrong, f'sweep/pose has {text}'
    posed = given.posed(poses, np.diag([0.01, 0.01, 0.005]) ** 2)
    wrong = replace(posed, mount=replace(mount, axis_rpy=(0.0, 0.0, 5.0)))
    yield 'rpy yaw 5, with sweep/pose', wrong, 'pan_axis.*radians'
    # Written down before any was tried.
    first, last, paper = colors[0], colors[-1], papers[0]
    wrong = given.paper(0, width=paper.height, height=paper.width)
    yield f'own: {first} turned', wrong, f'width and height of the {first} paper'
    yield f'own: {last} as A3', given.sized(-1, 1.414), f'{last} paper is'
    yield f'own: {color} 8 cm into the room', given.hung(middle, in_m=0.08), hung
    yield 'own: all papers 4 % larger', given.redrawn(sheets=1.04), 'papers look .* smaller'
    x, y, z = mount.axis_xyz
    higher = replace(given, mount=replace(mount, axis_xyz=(x, y, z + 0.12)))
    yield 'own: camera 12 cm higher', higher, 'height -11'
    tilted = replace(given, mount=replace(mount, axis_rpy=(0.05, 0.0, 0.0)))
    yield 'own: axis rolled by 3 deg', tilted, 'axis_roll -2.8'
    normal = given.room.walls[int(given.room.nearest_wall(np.array(paper.center[:2])))].normal
    before = np.add(paper.center[:2], 0.01 * normal[:2])
    across = max(given.room.raycast(before, np.arctan2(normal[1], normal[0]))[0], 0.0)
    wrong = given.hung(0, in_m=float(across) + 0.01)
    yield f'own: {first} on the opposite wall', wrong, f'{first} paper is hidden'
    yield 'own: pan 1.3 times', given.pans(lambda pan: 1.3 * pan), 'times the pan that is reported'
    yield 'own: focal length 5 % larger', given.focal(1.05), 'focal length'
    still = given.sweeps[0].frames[0].image
    frozen = given.frames(lambda frame: replace(frame, image=still))
    yield 'own: camera frozen', frozen, 'images do not turn'
    # Further errors of room.yaml, with the list of that name in `stream_errors`.
    feet = 1.0 / 0.3048
    text = 'feet|times|smaller|higher'
    yield 'further: room in feet', given.redrawn((feet, feet, feet), feet), text
    yield 'further: plan mirrored', given.redrawn((1.0, -1.0, 1.0)), 'mirrored|swapped'
    yield 'further: all papers given as A3', given.redrawn(sheets=1.414), 'papers look .* smaller'
    clockwise = copy.copy(given.room)
    walls = tuple(replace(w, start=w.end, end=w.start) for w in given.room.walls[::-1])
    object.__setattr__(clockwise, 'walls', walls)  # as a file may have it
    yield 'further: walls clockwise', replace(given, room=clockwise), 'clockwise'
    wrong, text = given.paper(-1, color='yellow'), 'yellow paper is hidden, of another colour'
    yield f'further: {last} given as yellow', wrong, text


def check_errors(folder, only):
    """Print what is found of each error, and count those that are not named."""
    room, mount = load_room(folder / 'room.yaml'), load_robot(folder / 'robot.yaml')
    bag = Bag(folder / 'learn')
    given = Given(room, mount, tuple(read_sweeps(bag, mount)))
    poses = truth_of_bag(bag).at([sweep.stamp_ns for sweep in given.sweeps])
    missed = total = 0
    for name, wrong, expected in errors_of(given, poses):
        if only not in name:
            continue
        with tempfile.TemporaryDirectory() as temporary:
            output = Path(temporary)
            (output / 'learn').symlink_to((folder / 'learn').resolve())
            (output / 'room.yaml').write_text(room_document(wrong.room), encoding='utf-8')
            (output / 'robot.yaml').write_text(robot_document(wrong.mount), encoding='utf-8')
            with patch('landmark_nav.cli.learn.read_sweeps', lambda *_, of=wrong: iter(of.sweeps)):
                refusal, warned = learn(output)
        text = ' '.join((refusal or warned).replace(str(output), '').split())
        named = re.search(expected, text) is not None
        missed, total = missed + (not named), total + 1
        how = 'refused' if refusal else 'learned'
        print(f'| {name} | {how} | {text or "-"} | {"yes" if named else "NO"} |', flush=True)
    print(f'{total - missed} of {total} causes are named')
    return missed


def main():
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seed', type=int, default=5100)
    parser.add_argument('--only', default='', help='cases whose name holds this')
    parser.add_argument('--errors', type=Path, metavar='FOLDER', help='recorded sweeps to falsify')
    args = parser.parse_args()
    cv2.setNumThreads(1)
    if args.errors:
        return 1 if check_errors(args.errors, args.only) else 0
    bad = 0
    for case in cases(args.seed):
        if args.only not in case.name:
            continue
        with tempfile.TemporaryDirectory() as folder:
            good, output = judge(case, Path(folder), args.seed)
        bad += not good
        print(f'{"ok  " if good else "BAD "} {case.name}: {output}', flush=True)
    return 1 if bad else 0
