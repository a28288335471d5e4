"""Commands: help, wrong usage, errors in one line, completion, keys of `drive`."""

import os
from pathlib import Path
import re
import subprocess
import sys
import types
from typing import Any

from harness import BAGS
import pytest

from landmark_nav.cli.drive import Keys
from landmark_nav.cli.main import COMMANDS, main
from landmark_nav.errors import LandmarkNavError

LEARN = ['learn', 'bag', '--robot', 'x', '--out', 'z']
NO_TOPICS = ('odom', 'odom=', 'wheels=/odom', '=/odom')
EVALUATE = ['evaluate', 'b', '--map', 'm', '--robot', 'r']


@pytest.fixture
def command(monkeypatch):
    """What command `learn` raises; it is replaced by one that does nothing else."""
    module: Any = types.ModuleType('landmark_nav.cli.learn')
    raised: list[BaseException] = []

    def run(args):
        raise raised[-1]

    module.add_arguments, module.run = lambda parser: parser.add_argument('bag'), run
    monkeypatch.setitem(sys.modules, 'landmark_nav.cli.learn', module)
    return raised


@pytest.mark.parametrize(
    ('words', 'meant'),
    [
        (['lern', 'bag'], 'learn'),
        (['evaluate', 'bag', '--map', 'm', '--robot', 'r', '--reprot', 'F'], '--report'),
        (['call', 'capture_swep'], 'capture_sweep'),
        (['map', 'shw', 'm'], 'show'),
        (['map', 'show', 'm', '--quite'], '--quiet'),
    ],
)
def test_what_was_meant_is_asked_for(words, meant, capsys):
    assert main(words) == 2
    assert f'did you mean {meant}?' in capsys.readouterr().err


@pytest.mark.parametrize('arguments', [[], ['no-such-thing'], ['learn', '--frobnicate']])
def test_wrong_usage_is_status_2(arguments, command, capsys):
    assert main(arguments) == 2
    assert 'usage: landmark-nav' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('error', 'line'),
    [
        (LandmarkNavError('room.yaml: no walls: add some'), 'room.yaml: no walls: add some'),
        (LandmarkNavError('two\n  lines'), r'two\n  lines'),
        (PermissionError(13, 'Permission denied', '/map'), '/map: Permission denied'),
        (ModuleNotFoundError('x', name='cv2'), 'cv2 is not installed: pip install opencv-pyth'),
        (ModuleNotFoundError('x', name='rclpy.node'), 'needs ROS 2 and rclpy is not installed: '),
        (ModuleNotFoundError('x', name='std_srvs.srv'), 'needs ROS 2 and std_srvs is not inst'),
    ],
)
def test_what_a_user_can_mend_is_one_line(error, line, command, capsys):
    command.append(error)
    assert main(['learn', 'bag']) == 1
    printed = capsys.readouterr().err
    assert printed.startswith(f'landmark-nav learn: {line}')
    assert printed.count('\n') == 1


def test_a_bug_keeps_its_traceback_and_an_interruption_its_status(command):
    command.append(ModuleNotFoundError('x', name='landmark_nav.gone'))
    with pytest.raises(ModuleNotFoundError):
        main(['learn', 'bag'])
    command.append(KeyboardInterrupt())
    assert main(['learn', 'bag']) == 130


def test_a_reader_that_leaves_is_no_error():
    # The other end of the pipe is closed before anything is written.
    code = (
        'import sys, types\n'
        'command = types.ModuleType("learn")\n'
        'command.add_arguments = lambda parser: None\n'
        'command.run = lambda args: print("x" * 10**6) or 0\n'
        'sys.modules["landmark_nav.cli.learn"] = command\n'
        'from landmark_nav.cli.main import main\n'
        'sys.exit(main(["learn"]))\n'
    )
    with subprocess.Popen(
        [sys.executable, '-c', code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        process.stdout.close()
        assert process.stderr.read() == ''
        process.wait(timeout=20)


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        (['learn', '', '--room', 'r', '--robot', 'r', '--out', 'm'], 'an argument is empty'),
        (['map', 'show', ''], 'an argument is empty'),
        (['bench', '--seed', '1\n2' * 1000], 'argument --seed: '),
        (['plan', '--room', 'r', '--robot', 'r', '--out', 'p', '--positions', '1'], '--positions'),
        (['plan', '--room', 'r', '--robot', 'r', '--out', 'p.png', '--positions', '2'], '--out'),
        (['evaluate', 'b', '--map', 'm', '--robot', 'r', '--report', 'page.txt'], '--report'),
        (['panorama', 'b', '--out', 'p.jpg'], '--out'),
        (['panorama', 'b', '--out', 'p.png', '--sweep', '0'], 'argument --sweep'),
        (['figures', '--out', 'f', '--bag', 'b'], '--bag needs'),
        (['figures', '--out', 'f', '--seed', '-1'], '--seed'),
        (['simulate', '--out', 'o', '--seed', '-3'], '--seed'),
        (['simulate', '--out', 'o', '--exchange', '20'], '--exchange'),
        (['simulate', '--out', 'o', '--camera-rate', '7'], 'no whole part of 20: take'),
        *(([*LEARN, '--topic', topic], 'is not NAME=TOPIC') for topic in NO_TOPICS),
        ([*EVALUATE, '--start', 'nan', '1.0', '0.0'], 'argument --start: '),
        ([*EVALUATE, '--start', '1.0', '1e200', '0.0'], 'argument --start: '),
        ([*EVALUATE, '--start', '1.0', '1.0', 'here'], 'argument --start: '),
        ([*EVALUATE, '--start-sigma', '0.1', '0'], '0 is not from 1e-09 to 2e+07'),
        ([*EVALUATE, '--start-sigma', 'inf', '0.1'], 'inf is not from 1e-09 to 2e+07'),
    ],
)
def test_arguments_that_cannot_be_are_status_2_and_one_line(arguments, complaint, capsys):
    assert main(arguments) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert complaint in line
    assert len(line) <= 200


@pytest.mark.parametrize(
    ('bag', 'room', 'complaint'),
    [
        ('drive', None, 'a recording of a drive, .*: give a bag of sweeps, such as bags/learn'),
        ('learn', 'walls.yaml', r'walls\.yaml: has no papers and .* scale: give --paper-size or'),
        ('learn', BAGS / 'robot.yaml', 'this is a robot file: give it as --robot'),
        ('room.yaml', None, r"not a bag \(it begins with '# metres'\): give a rosbag2 folder"),
    ],
)
def test_a_wrong_file_is_one_line(bag, room, complaint, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('walls.yaml').write_text((BAGS / 'room.yaml').read_text().partition('reference_area')[0])
    words = ['learn', str(BAGS / bag), '--robot', str(BAGS / 'robot.yaml'), '--out', 'map']
    assert main([*words, *(['--room', str(room)] if room else [])]) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert re.search(complaint, line)
    assert len(line) <= 220


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_explains_itself_without_ros(name, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    assert main([name, '--help']) == 0
    text = ' '.join(capsys.readouterr().out.split())
    assert text.startswith(f'usage: landmark-nav {name}')
    example = text.rpartition('landmark-nav ')[2]
    assert example == COMMANDS[name][1]


@pytest.mark.parametrize(
    ('line', 'offered'), [('landmark-nav ev', 'evaluate'), ('landmark-nav learn --ro', '--robot')]
)
def test_a_shell_completes_commands_and_options(line, offered, tmp_path):
    environment = os.environ | {
        '_ARGCOMPLETE': '1',
        '_ARGCOMPLETE_STDOUT_FILENAME': str(tmp_path / 'offered'),
        'COMP_LINE': line,
        'COMP_POINT': str(len(line)),
        '_ARGCOMPLETE_COMP_WORDBREAKS': ' ',
    }
    command = [sys.executable, '-m', 'landmark_nav']
    subprocess.run(command, env=environment, timeout=120, check=False)
    assert offered in (tmp_path / 'offered').read_text()


def test_the_robot_stops_without_keys():
    keys = Keys(0.2, 0.5)
    assert keys.velocity(0.0) == (0.0, 0.0)
    keys.press('w', 0.0)
    keys.press('w', 0.7)
    assert keys.velocity(1.4) == pytest.approx((0.2, 0.0))
    assert keys.velocity(2.0) == (0.0, 0.0)
    keys.press('wx', 2.0)
    assert keys.ended
    assert keys.velocity(2.1) == (0.0, 0.0)


def test_help_loads_nothing_heavy():
    code = (
        'import sys\n'
        'from landmark_nav.cli.main import main\n'
        'main(["--help"])\n'
        'heavy = {"numpy", "cv2", "scipy", "matplotlib", "rosbags", "rclpy"} & set(sys.modules)\n'
        'sys.exit(f"loaded {heavy}" if heavy else 0)\n'
    )
    result = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=20
    )
    assert result.returncode == 0, result.stderr
