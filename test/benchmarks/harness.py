"""What benchmarks share: commands as users give them, recordings, errors and tables."""

import argparse
import json
from pathlib import Path
import tempfile

import cv2
import numpy as np

from landmark_nav.cli.main import main as landmark_nav
from landmark_nav.evaluation.metrics import error_summary
from landmark_nav.evaluation.replay import replay
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration

REPOSITORY = Path(__file__).resolve().parents[2]
BAGS, SETUPS = REPOSITORY / 'bags', REPOSITORY / 'test' / 'setups'
SHARED = REPOSITORY.parent / 'shared' / 'data'
STUDY = SHARED / 'study'
# Sigma of x, y and heading of a given start, as `landmark-nav evaluate` takes it.
START_SIGMA = np.array([0.05, 0.05, 0.035])


def command(*words):
    """`landmark-nav` with these words; ends the benchmark if it fails."""
    arguments = [str(word) for word in words]
    status = landmark_nav(arguments)
    if status != 0:
        raise SystemExit(f'landmark-nav {" ".join(arguments)}: exit status {status}')


def start_of(folder, name='start.json'):
    """Pose of the base in map at the start of the drive of a room."""
    return list(json.loads((folder / name).read_text(encoding='utf-8'))['pose'])


def learn(room, out, *options):
    """Learn the sweeps of a room to the map `out`; figures, also in `learn.json` beside it."""
    figures = out.with_name('learn.json')
    files = ('--room', room / 'room.yaml', '--robot', room / 'robot.yaml')
    command('learn', room / 'learn', *files, '--out', out, '--overwrite', '--json', figures,
            *options)  # fmt: skip
    return dict(json.loads(figures.read_text()))


def evaluate(room, learned, *options, start, drive=None, robot=None, out=None):
    """Evaluate the drive of a room, or another; figures, also in `run.json` beside the map."""
    figures = out or learned.with_name('run.json')
    given = () if start is None else ('--start', *start)
    files = ('--map', learned, '--robot', robot or room / 'robot.yaml', '--json', figures)
    command('evaluate', drive or room / 'drive', *files, *given, *options)
    return dict(json.loads(figures.read_text()))


def rooms_parser(text):
    """Parser of the arguments of simulated rooms."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument('--seeds', type=int, nargs='+', required=True)
    parser.add_argument('--maps', help='maps that were kept; {seed} stands for the seed')
    return parser


def learned_room(seed, maps=None, *options):
    """Map of a simulated room, learned as a user would; of `maps`, if they were kept."""
    if maps:
        return load_map(maps.format(seed=seed))
    with tempfile.TemporaryDirectory() as scratch:
        room, out = Path(scratch) / 'room', Path(scratch) / 'map'
        command('simulate', '--out', room, '--seed', seed, '--drive-seconds', 1, *options)
        learn(room, out)
        return load_map(out)


def as_jpeg(image, quality=90):
    """What is left of an image in a JPEG."""
    _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8)


def drive_parser(text, **defaults):
    """Parser of the arguments of a recorded drive; those with a default are optional."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument('drive', type=Path, nargs='?' if 'drive' in defaults else None)
    for name in ('map', 'robot'):
        parser.add_argument(f'--{name}', type=Path, required=name not in defaults)
    parser.add_argument(
        '--start', type=float, nargs=3, required='start' not in defaults,
        metavar=('X', 'Y', 'THETA'),
    )  # fmt: skip
    parser.set_defaults(**defaults)
    return parser


class Drive:
    """A recorded drive, its map, and what is known of the robot and its start."""

    def __init__(self, bag, learned, known, start):
        self.bag, self.landmarks, self.known = Bag(bag), learned, known
        self.start = None if start is None else np.array(start)
        self.mount = known.mount

    @classmethod
    def of(cls, given):
        """Drive of the arguments of `drive_parser`."""
        landmarks = load_map(given.map)
        known = landmarks.calibration_from(load_calibration(given.robot))
        return cls(given.drive, landmarks, known, given.start)

    def events(self):
        """Return what was sensed."""
        return list(sensor_events(self.bag, self.mount))

    def run(self, events, known=None):
        """Localize by events, such as these, changed."""
        return replay(
            events, self.landmarks, known or self.known, LocalizationConfig(), self.start,
            np.diag(START_SIGMA**2),
        )  # fmt: skip


def summary(errors):
    """RMSE, median, 95 % and greatest error of positions [mm], RMSE of headings [deg]."""
    known = {name: np.nan if v is None else v for name, v in error_summary(errors).items()}
    names = ('rmse', 'median', 'p95', 'max')
    figures = {name: 1e3 * known[f'position_{name}_m'] for name in names}
    return {**figures, 'heading': known['heading_rmse_deg']}


def rms(values):
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float('nan')


def print_row(row, width, first=False, digits=4):
    """Print the values of a row of a table, below their names if it is the first one."""
    if first:
        print('\n' + '  '.join(f'{name:>{width}}' for name in row))
    cells = (v if isinstance(v, str) else f'{v:.{digits}g}' for v in row.values())
    print('  '.join(f'{cell:>{width}}' for cell in cells), flush=True)


def figures_of(run):
    """What tables show of a report of `evaluate`, millimetres and degrees."""
    return {
        'fused_mm': 1e3 * run['fused']['position_rmse_m'],
        'fused_deg': run['fused']['heading_rmse_deg'],
        'availability': run['availability'],
        'nees': run['nees']['mean'],
        'beyond_5s': run['silently_wrong'],
        'crlb_ratio': run['crlb_ratio'],
        'landmarks': run['landmarks'],
    }


def any_of(parts, name):
    """Whether a name holds one of the parts that `--only` gives, or none is given."""
    return not parts or any(part in name for part in parts)


def within(bounds, row):
    """Whether each figure of a row is between its bounds."""
    return all(low <= row[name] <= high for name, (low, high) in bounds.items())
