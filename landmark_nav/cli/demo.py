"""`landmark-nav demo`: learn, drive and localize on a ROS graph with a simulated robot."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import shutil

from landmark_nav.cli.learn import located_sweeps
from landmark_nav.cli.options import add, table_lines
from landmark_nav.configuration import load_configuration
from landmark_nav.demo import scenario
from landmark_nav.demo.supervisor import Interruption, node_commands, node_environment, Supervisor
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.report import drive_page, FrameStrip, panoramas, write_report
from landmark_nav.evaluation.report.tables import drive_tables
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.unmeasured import learn_located
from landmark_nav.ros import chosen_domain, require_ros
from landmark_nav.storage.atomic_io import check_new, write_json
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration, shipped_config
from landmark_nav.storage.setup_files import load_room
from landmark_nav.types import CameraFrame, Panorama

# Files of a demo, including those of older versions; a folder with other files is refused.
_OWN = (
    *('room.yaml', 'robot.yaml', 'logs', 'map', 'sweeps', 'recording', 'demo.json'),
    *('report.html', 'foxglove.json', 'map.png', 'panorama_1.png', 'panorama_2.png'),
    *('trajectory.png', 'errors.png'),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Start the nodes on a ROS graph with a simulated robot, let it take two '
        'sweeps, learn its landmarks by a service call and drive; record, measure and draw '
        'that. Exit status 0 only if the map and the error are as they should be. The nodes are '
        'in the ROS domain of ROS_DOMAIN_ID, or else in one for themselves.'
    )
    add(parser, '--out', required=True)
    add(parser, '--overwrite')
    add(parser, '--seed', help='of the room')
    text = 'give it no plan and no measured papers: walls and poses are found, the scale is that '
    text += 'of odom; the sweeps are recorded too'
    add(parser, '--unmeasured', action='store_true', help=text)


def run(args: argparse.Namespace) -> int:
    """Run the demo, then evaluate its recording."""
    require_ros('it')
    domain_id = chosen_domain()
    domain_id = 10 + os.getpid() % 90 if domain_id is None else domain_id
    folder = _emptied(args.out, args.overwrite)
    narrator = scenario.Narrator()
    room = scenario.prepare_room(folder, args.seed, measured=not args.unmeasured)
    shutil.copyfile(shipped_config('foxglove/landmark_nav.json'), folder / 'foxglove.json')
    commands = node_commands(
        room.robot_file,
        room.room_file,
        folder / 'map',
        simulator={'seed': room.seed},
        # Raw images exceed the shared memory of common ROS middleware.
        image_transport='compressed',
    )
    environment = node_environment(domain_id)
    os.environ.update(environment)
    narrator.print_line(f'to look at the topics meanwhile: export ROS_DOMAIN_ID={domain_id}')
    with Interruption() as interruption, Supervisor(folder / 'logs', environment) as supervisor:
        from landmark_nav.ros.robot_client import RobotClient

        def watch() -> None:
            interruption.check()
            supervisor.check()

        for name, command in commands.items():
            supervisor.start(name, command)
        with RobotClient(domain_id, watch) as robot:
            scenario.run_scenario(robot, room, commands, folder, narrator)
            swept = robot.panoramas
        unclean = [name for name, status in supervisor.stop().items() if status]
    return _report(folder, args.command_line, swept, unclean, narrator)


def _emptied(folder: Path, overwrite: bool) -> Path:
    """Delete the files of an earlier demo in the folder."""
    if folder.exists() and not folder.is_dir():
        raise LandmarkNavError(f'{folder}: is a file: take another name')
    folder.mkdir(parents=True, exist_ok=True)
    foreign = sorted(path.name for path in folder.iterdir() if path.name not in _OWN)
    if foreign:
        raise LandmarkNavError(f'{folder}: holds {", ".join(foreign[:3])}: take another folder')
    check_new(overwrite, *folder.iterdir())
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    return folder.resolve()


def _report(
    folder: Path,
    command: str,
    swept: list[Panorama],
    unclean: list[str],
    narrator: scenario.Narrator,
) -> int:
    """Evaluate the recording, write the report, and check the results."""
    narrator.title('Measuring the recording against the ground truth')
    landmarks = load_map(folder / 'map')
    bag, calibration = Bag(folder / 'recording'), load_calibration(folder / 'robot.yaml')
    measured, run = scenario.figures(scenario.recorded_run(bag), landmarks)
    strip = FrameStrip()
    # Images before the first joint states are not part of the run; their warnings are ignored.
    for event in sensor_events(bag.warning_to(lambda _: None), calibration.mount):
        if isinstance(event, CameraFrame):
            strip.add(event)
    # The node gives the map only; the same stages are repeated for the outcome of each candidate.
    inputs = {'recording': bag.path, 'map': folder / 'map'}
    room = None if landmarks.has_own_frame else load_room(folder / 'room.yaml')
    if room is None:
        stages = load_configuration(None, folder / 'robot.yaml')
        located, _ = located_sweeps(Bag(folder / 'sweeps'), calibration, stages, StageLog())
        learned = learn_located(located, stages)
    else:
        learned = learn_from_panoramas(swept, room, LearningConfig())
        inputs['room'] = folder / 'room.yaml'
    papers = room.anchors if room else ()
    page = drive_page(measured, run, landmarks, calibration, strip, papers=papers)
    page['data']['panoramas'] = panoramas(learned)
    write_report(folder / 'report.html', page, 'Demo', command, inputs)
    write_json(folder / 'demo.json', measured)
    if measured.get('aligned'):
        narrator.print_line('errors after one rigid alignment: the map has a frame of its own')
    for line in table_lines(drive_tables(measured)[0]):
        narrator.print_line(line)
    checks = scenario.judge(measured)
    if unclean:
        text = f'{", ".join(unclean)} did not end cleanly: see logs/'
        checks.append(scenario.Check(False, text))
    narrator.title('Result')
    for check in checks:
        narrator.print_line(f'{"ok    " if check.passed else "FAILED"}  {check.text}')
    narrator.print_line(f'{narrator.seconds:.0f} s; all of it is in {folder}:')
    narrator.print_line('report.html to play it, demo.json, map/, recording/ (MCAP), logs/')
    return 0 if all(check.passed for check in checks) else 1
