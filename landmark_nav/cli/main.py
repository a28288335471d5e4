"""
`landmark-nav COMMAND`: finds and runs the command, and reports errors in one line.

Only the module of the given command is imported, so that help is fast and a missing optional
dependency affects its own command only.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from contextlib import suppress
import difflib
from importlib import import_module
from io import TextIOWrapper
import logging
import os
from pathlib import Path
import shlex
import signal
import sys
from typing import Any, NoReturn
import warnings

from landmark_nav.errors import LandmarkNavError, one_line, release, shown, UsageError, why
from landmark_nav.signals import interrupting
from landmark_nav.threads import keep_to_one_thread

# Command -> description and example; the module has the same name.
COMMANDS = {
    'demo': ('learn, drive and localize with a simulated robot (ROS)', 'demo --out demo'),
    'learn': ('make a map out of a bag of sweeps',
              'learn bags/learn --room bags/room.yaml --robot bags/robot.yaml --out map'),
    'calibrate': ('a better robot.yaml out of sweeps and drives',
                  'calibrate drive --map map --robot robot.yaml --out better.yaml'),
    'check': ('say what is wrong with a recording', 'check drive --robot robot.yaml --map map'),
    'evaluate': ('run a drive bag through the localizer and measure its errors',
                 'evaluate bags/drive --map map --robot bags/robot.yaml --report run.html'),
    'panorama': ('make a panorama out of a sweep', 'panorama sweep --out panorama.png'),
    'plan': ('propose where to take panoramas',
             'plan --room room.yaml --robot robot.yaml --positions 3 --out plan.yaml'),
    'simulate': ('write bags of simulated sweeps and drives',
                 'simulate --out room --seed 7 --light-change'),
    'convert': ('make a bag and a map of the log of another project',
                'convert mrclam MRCLAM_Dataset1 --robot 1 --out mrclam'),
    'play': ('play a bag onto topics with /clock (ROS)', 'play bags/drive --rate 2'),
    'up': ('start all nodes, with a simulated robot if need be (ROS)', 'up --sim'),
    'call': ('call a service of the nodes (ROS)', 'call learn_landmarks'),
    'drive': ('drive the robot by keys (ROS)', 'drive'),
    'status': ('print how the nodes are (ROS)', 'status'),
    'batch': ('many recordings at once, one table',
              'batch jobs.yaml --out results --against earlier'),
    'map': ('work on maps: show, check, diff, merge, migrate', 'map show map'),
    'figures': ('draw the figures of Livatino and Madsen from own data', 'figures --out figures'),
    'bench': ('time every stage beside a reference', 'bench --json bench.json'),
    'completion': ('print what makes a shell complete commands',
                   'completion bash >> ~/.bash_completion'),
}  # fmt: skip

# Options that name output files.
_OUTPUTS = {'out', 'json', 'report', 'tum', 'video', 'walls_out'}
# Names and ends of the files that are read of a folder: of a map, or of a bag.
_READ, _OF_BAGS = ('map.yaml', 'metadata.yaml'), ('.mcap', '.db3', '.bag', '.zstd', '.lz4')

# Module -> distribution, if their names differ.
_DISTRIBUTIONS = {'cv2': 'opencv-python-headless', 'yaml': 'PyYAML'}


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command and return its exit status.

    It is 0: done, 1: the data do not allow it, 2: wrong usage, 130: after SIGINT, 143: after
    SIGTERM.
    """
    keep_to_one_thread()
    # Characters that the terminal's encoding lacks must not raise an error.
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors='backslashreplace')
    arguments = sys.argv[1:] if argv is None else list(argv)
    # For completion, the shell passes the line in the environment.
    words = os.environ.get('COMP_LINE', '').split()[1:] or arguments
    name = next((word for word in words if not word.startswith('-')), '')
    try:
        status = _run(name, arguments)
        _flush()
        return status
    except KeyboardInterrupt as interrupt:
        return 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)
    except BrokenPipeError:  # the reader of the output has ended (`| head`)
        with suppress(OSError):
            _flush()
        return 1
    except UsageError as error:
        status, message = 2, str(error)
    except LandmarkNavError as error:
        status, message = 1, str(error)
    except OSError as error:
        status, message = 1, f'{error.filename or "standard output or a file"}: {why(error)}'
    except MemoryError:
        status, message = 1, 'not enough memory: give less data, or smaller images'
    except ModuleNotFoundError as error:
        status, message = 1, _missing(error)
    if sys.stderr is not None:  # the parent process may have closed it
        print(one_line(f'landmark-nav {name}: {message}'), file=sys.stderr)
    return status


class _Parser(argparse.ArgumentParser):
    """Parser that reports errors in one line of bounded length, after the usage."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(2, one_line(f'{self.prog}: error: {message}') + '\n')

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            known = [str(choice) for choice in action.choices]
            meant = _meant(str(value), known) or f': choose from {", ".join(known)}'
            raise argparse.ArgumentError(action, f'{shown(value)} is no choice{meant}')


def _run(name: str, arguments: list[str]) -> int:
    parser = _Parser(
        prog='landmark-nav',
        description='Lets a robot with one turning camera learn its landmarks by itself.',
        epilog='landmark-nav COMMAND --help shows more. What is marked (ROS) needs ROS 2, the '
        'rest does not. Exit status: 0 done, 1 the data does not allow it (the message says why), '
        '2 wrong usage.',
    )
    parser.add_argument('--version', action='version', version=f'landmark-nav {release()}')
    _add_verbosity(parser, 0)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    command = None
    asked: argparse.ArgumentParser = parser
    for known, (summary, example) in COMMANDS.items():
        subparser = commands.add_parser(known, help=summary)
        if known == name:
            # OpenCV's messages on broken images repeat our own line, which names the file.
            os.environ.setdefault('OPENCV_LOG_LEVEL', 'SILENT')
            command = import_module(f'landmark_nav.cli.{name}')
            command.add_arguments(subparser)
            actions = actions_of(subparser)
            for one in (subparser, *actions.values()):
                _add_verbosity(one, argparse.SUPPRESS)
                if one is subparser or not one.epilog:
                    listed = f'{one.epilog}\n\n' if one.epilog else ''
                    one.epilog = f'{listed}example: landmark-nav {example}'
            asked = next((actions[word] for word in arguments if word in actions), subparser)
    if '_ARGCOMPLETE' in os.environ:
        import_module('argcomplete').autocomplete(parser)
    if not arguments:
        parser.print_help(sys.stderr)
        return 2
    try:
        if '' in arguments:
            parser.error('an argument is empty: is a variable of the shell not set?')
        if name and command is None:
            parser.error(f'{shown(name)} is no command{_meant(name, COMMANDS)}')
        args, strange = parser.parse_known_args(arguments)
        if strange:
            options = _meant(strange[0], asked._option_string_actions)
            asked.error(f'{shown(strange[0])} is not understood{options}')
    except SystemExit as stop:  # argparse has printed help or an error
        return stop.code if isinstance(stop.code, int) else 2
    assert command is not None, 'argparse requires a known command'
    args.command_line = shlex.join(['landmark-nav', *arguments])
    _set_up_logging(args.verbosity)
    _check_apart(args)
    with interrupting():
        return int(command.run(args))


def actions_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Parsers of the actions of a command, such as ``show`` of ``map``."""
    kinds = (k for k in parser._actions if isinstance(k, argparse._SubParsersAction))
    return {name: one for kind in kinds for name, one in kind.choices.items()}


def _add_verbosity(parser: argparse.ArgumentParser, default: Any) -> None:
    """Declare the options of verbosity, which are allowed before and after the command."""
    group = parser.add_mutually_exclusive_group()
    kept = {'dest': 'verbosity', 'action': 'store_const', 'default': default}
    group.add_argument('-v', '--verbose', const=1, help='say what is being done', **kept)
    group.add_argument('-q', '--quiet', const=-1, help='no progress and no warnings', **kept)


def _meant(word: str, known: Iterable[str]) -> str:
    """Return a suggestion of a similar known word, if there is one."""
    like = difflib.get_close_matches(word.partition('=')[0], list(known), 1)
    return f': did you mean {like[0]}?' if like else ''


def _check_apart(args: argparse.Namespace) -> None:
    """Refuse output files that are also read, by themselves or in their folder."""
    for output in _OUTPUTS:
        file = getattr(args, output, None)
        if not isinstance(file, str | Path) or not os.path.isfile(file):
            continue
        for name, value in vars(args).items():
            # Some commands may replace their input.
            replaced = output == 'out' and name == getattr(args, 'replaces', None)
            paths = value if isinstance(value, list) else [value]
            if name not in _OUTPUTS and not replaced and any(_reads(p, file) for p in paths):
                option = output.replace('_', '-')
                raise UsageError(f'--{option} {file}: is read, too: take another name')


def _reads(given: Any, file: str | Path) -> bool:
    """Whether a file is what an argument names, or is read of the folder that it names."""
    if not isinstance(given, str | Path) or not os.path.exists(given):
        return False
    name = os.path.basename(file)
    inside = os.path.isdir(given) and Path(file).resolve().is_relative_to(Path(given).resolve())
    return os.path.samefile(given, file) or (inside and (name in _READ or name.endswith(_OF_BAGS)))


def _flush() -> None:
    """Flush standard output; this reports a full disk."""
    if sys.stdout is None:  # the parent process may have closed it
        return
    try:
        sys.stdout.flush()
    except OSError:
        # Discard the rest, which would fail again at the end of the process.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def _set_up_logging(verbosity: int) -> None:
    """Log to stderr in lines, including warnings of libraries."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_OneLine('%(levelname)s: %(message)s'))
    logging.basicConfig(level=logging.WARNING - 10 * verbosity, handlers=[handler])
    logging.captureWarnings(True)
    warnings.formatwarning = lambda message, category, *_, **__: f'{category.__name__}: {message}'


class _OneLine(logging.Formatter):
    """Formatter of one line for each record; tracebacks follow below."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        return one_line(super().formatMessage(record))


def _missing(error: ModuleNotFoundError) -> str:
    """Return the message of a missing dependency; raise `error` again for our own modules."""
    module = (error.name or '').partition('.')[0]
    if module in ('', 'landmark_nav'):
        raise error
    if module == 'rclpy' or module.endswith(('_msgs', '_srvs', '_interfaces')):
        return (
            f'needs ROS 2 and {module} is not installed: source a ROS 2 workspace or install '
            f"landmark_nav with its wheels (pip install '.[ros]')"
        )
    return f'{module} is not installed: pip install {_DISTRIBUTIONS.get(module, module)}'
