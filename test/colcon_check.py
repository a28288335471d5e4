"""
Builds a workspace with colcon, as it is and with symbolic links, and starts what it installs.

`make test-colcon` runs it in an environment with colcon and ROS 2 and without landmark_nav.
"""

import os
from pathlib import Path
import subprocess
import sys
import tempfile

REPOSITORY = Path(__file__).resolve().parents[1]
EXECUTABLES = sorted(path.name for path in (REPOSITORY / 'resource/executables').iterdir())
CONFIG = sorted(path.name for path in (REPOSITORY / 'config').iterdir())
LAUNCH = sorted(path.name for path in (REPOSITORY / 'landmark_nav/launch').glob('*.py'))
SHARE = [*(f'config/{name}' for name in CONFIG), *(f'launch/{name}' for name in LAUNCH)]


def check(workspace, *options):
    """Build with these options in an empty folder; what is not as it should be."""
    colcon = Path(sys.executable).with_name('colcon')
    bases = ('--build-base', workspace / 'build', '--install-base', workspace / 'install')
    built = subprocess.run(
        [
            colcon,
            '--log-base',
            workspace / 'log',
            'build',
            '--paths',
            REPOSITORY,
            *bases,
            *options,
        ],
        capture_output=True,
        text=True,
    )
    if built.returncode:
        return [built.stderr]
    wrong = [built.stderr] if built.stderr else []
    prefix = workspace / 'install' / 'landmark_nav'
    wanted = [prefix / 'share/ament_index/resource_index/packages/landmark_nav']
    wanted += [prefix / 'share/landmark_nav' / name for name in ('package.xml', *SHARE)]
    wrong += [f'{path} is missing' for path in wanted if not path.is_file()]
    index = 'from ament_index_python import packages; '
    index += 'print(packages.get_package_prefix("landmark_nav"))'
    commands = [[str(prefix / 'lib/landmark_nav' / name), '--help'] for name in EXECUTABLES]
    commands += [['landmark-nav', '--version'], [sys.executable, '-c', index]]
    for command in commands:
        done = subprocess.run(
            ['sh', '-c', '. "$0"; exec "$@"', workspace / 'install' / 'setup.sh', *command],
            cwd=workspace,
            capture_output=True,
            text=True,
        )
        if done.returncode or not done.stdout:
            wrong.append(f'{command[0]}: {done.stdout}{done.stderr}')
    if done.stdout.strip() != str(prefix):
        wrong.append(f'the index leads to {done.stdout.strip()}')
    return wrong


def main():
    """Build both ways and report; exit status 1 if anything is wrong."""
    failed = False
    # One would find the package without colcon, the other makes it warn.
    for name in ('PYTHONPATH', 'PYTHONDONTWRITEBYTECODE'):
        os.environ.pop(name, None)
    for options in ((), ('--symlink-install',)):
        with tempfile.TemporaryDirectory() as workspace:
            wrong = check(Path(workspace), *options)
        print('colcon build', *options, '' if wrong else f': {len(EXECUTABLES)} nodes start')
        print(*wrong, sep='\n', end='\n' if wrong else '')
        failed |= bool(wrong)
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
