"""
`landmark-nav COMMAND`: finds the command, runs it, and turns what fails into one line.

A command's module is imported only if it is the one asked for, so that help is quick and a
missing optional dependency breaks its own command alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
import logging
import os
import sys
import warnings

from landmark_nav.errors import LandmarkNavError, why
from landmark_nav.threads import keep_to_one_thread

__all__ = ['main']

# Command -> its module and what it does.
COMMANDS = {
    'demo': ('demo', 'learn, drive and localize with a simulated robot (ROS)'),
    'learn': ('learn', 'make a map out of a bag of sweeps'),
    'check': ('check', 'say what is wrong with a recording'),
    'evaluate': ('evaluate', 'run a drive bag through the localizer and measure its errors'),
    'panorama': ('panorama', 'make a panorama out of a sweep'),
    'plan': ('plan', 'propose where to take panoramas'),
    'simulate': ('simulate', 'write bags of simulated sweeps and drives'),
    'convert': ('convert', 'make a bag and a map of the log of another project'),
    'play': ('play', 'play a bag onto topics with /clock (ROS)'),
    'map': ('maps', 'list, check, compare, join maps'),
    'figures': ('figures', 'draw the figures of Livatino and Madsen from own data'),
    'bench': ('bench', 'time every stage beside a reference'),
}

# Distributions that are not called as the module they hold.
_DISTRIBUTIONS = {'cv2': 'opencv-python-headless', 'yaml': 'PyYAML'}


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments after the program's name; the process's own by default.

    Returns
    -------
    int
        Exit status: 0 done, 1 the data does not allow it, 2 wrong usage, 130 interrupted.

    """
    keep_to_one_thread()
    arguments = sys.argv[1:] if argv is None else list(argv)
    name = next((word for word in arguments if not word.startswith('-')), '')
    try:
        return _run(name, arguments)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Whoever read our output has gone (`| head`): nothing to say, and nowhere to flush to.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except LandmarkNavError as error:
        message = str(error)
    except OSError as error:
        message = f'{error.filename}: {why(error)}' if error.filename else str(error)
    except ModuleNotFoundError as error:
        message = _missing(error)
    print(f'landmark-nav {name}: {" ".join(message.split())}', file=sys.stderr)
    return 1


def _run(name: str, arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog='landmark-nav',
        description='Lets a robot with one turning camera learn its landmarks by itself.',
        epilog='landmark-nav COMMAND --help tells more. What is marked (ROS) needs ROS 2, the '
        'rest does not. Exit status: 0 done, 1 the data does not allow it (the message says why), '
        '2 wrong usage.',
    )
    parser.add_argument('--version', action='version', version=f'landmark-nav {_version()}')
    parser.add_argument('-v', '--verbose', action='store_true', help='say what is being done')
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    command = None
    for known, (module, summary) in COMMANDS.items():
        subparser = commands.add_parser(known, help=summary)
        if known == name:
            # What OpenCV says of a broken picture, beside the line of ours that names the file.
            os.environ.setdefault('OPENCV_LOG_LEVEL', 'SILENT')
            command = import_module(f'landmark_nav.cli.{module}')
            command.add_arguments(subparser)
    if not arguments:
        parser.print_help(sys.stderr)
        return 2
    try:
        args = parser.parse_args(arguments)
    except SystemExit as stop:  # argparse has printed its help or what is wrong
        return stop.code if isinstance(stop.code, int) else 2
    assert command is not None, 'argparse requires a known command'
    _set_up_logging(args.verbose)
    status = int(command.run(args))
    sys.stdout.flush()
    return status


def _set_up_logging(verbose: bool) -> None:
    """Log to stderr, warnings of libraries included, a line each."""
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format='%(levelname)s: %(message)s',
        stream=sys.stderr,
    )
    logging.captureWarnings(True)
    warnings.formatwarning = lambda message, category, *_, **__: f'{category.__name__}: {message}'


def _version() -> str:
    try:
        return version('landmark_nav')
    except PackageNotFoundError:
        return '(not installed)'


def _missing(error: ModuleNotFoundError) -> str:
    """Say which dependency is missing; raise `error` again if it is a module of our own."""
    module = (error.name or '').partition('.')[0]
    if module in ('', 'landmark_nav'):
        raise error
    if module == 'rclpy' or module.endswith(('_msgs', '_srvs', '_interfaces')):
        return (
            f'needs ROS 2 and {module} is not installed: source a ROS 2 workspace or install '
            f"landmark_nav with its wheels (pip install '.[ros]')"
        )
    return f'{module} is not installed: pip install {_DISTRIBUTIONS.get(module, module)}'
