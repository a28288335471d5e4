"""
What each mechanism is worth: learn and drive with it and without, one line a mechanism.

``python test/benchmarks ablation ROOMS`` takes `bags/`, the study and MR.CLAM where they are, and
the rooms of ``landmark-nav simulate`` in the folder ROOMS, which are made there if it has
none. A mechanism is left out by one constant, or one function, that is put in its place.
"""

import argparse
import contextlib
from dataclasses import fields, is_dataclass
from importlib import import_module
import io
import json
import multiprocessing
from pathlib import Path
from typing import Any

from harness import BAGS, command, evaluate, figures_of, learn, SHARED, start_of, STUDY
import numpy as np

from landmark_nav.learning.panorama.photometry import Photometry
from landmark_nav.localization.detection.appearance import Texture
from landmark_nav.types import Refusal

SEEDS = (8301, 8302, 8303)
BEST = 1e9

_LEARN, _FIND = 'landmark_nav.learning.', 'landmark_nav.localization.'
_ATTENTION, _ELECT = f'{_LEARN}attention.maps:AttentionConfig.', f'{_LEARN}election:'
_WALL = f'{_LEARN}stereo.wall_stereo:'
_ADJUST = f'{_LEARN}adjustment.problem:AdjustmentConfig.'


def _nothing(*_, **__):
    return None


# Name -> what is put in place of what: a constant, a field of a configuration, a function.
LEARNING: dict[str, dict[str, Any]] = {
    'depth from sizes': {f'{_WALL}log_nearer': lambda *_: (0.0, np.inf)},
    'quarters of a patch': {f'{_WALL}displaced_quarter': lambda *_: 0.0},
    'way back': {f'{_WALL}_MAX_RETURN_PX': BEST},
    'one peak (stereo)': {f'{_LEARN}stereo.wall_patch:StereoConfig.max_second_ratio': 1.0},
    'search off the walls': {
        f'{_LEARN}stereo.reconstruction:match_freely': lambda *_: Refusal('')
    },
    'exposures, vignetting': {
        f'{_LEARN}sweep_pipeline:measure_photometry': lambda s, _: Photometry.none(len(s.frames))
    },
    'median': {f'{_LEARN}panorama.synthesis:_MIN_FOR_MEDIAN': 1000},
    'calibration by overlaps': {f'{_LEARN}calibration.sweep_calibration:_LEAST_PER_LINK': BEST},
    'refusal of what is ambiguous': {f'{_LEARN}attention.selection:refusal': _nothing},
    'symmetry': {f'{_ATTENTION}weight_symmetry': 0.0},
    'corners': {f'{_ATTENTION}weight_corners': 0.0},
    'edges': {f'{_ATTENTION}weight_edges': 0.0},
    'sizes of patches': {f'{_ATTENTION}size_max_px': 28},
    'candidates by sector': {f'{_ATTENTION}candidates_per_sector': 1000},
    'misfit (election)': {f'{_ELECT}_MAX_CHI_SQUARE': BEST},
    'off wall (election)': {f'{_ELECT}ElectionConfig.max_off_wall_m': 1.0},
    'depth (election)': {f'{_ELECT}ElectionConfig.max_depth_sigma_m': 1.0},
    'sigma (election)': {f'{_ELECT}ElectionConfig.max_sigma_m': 1.0},
    'incidence (election)': {f'{_ELECT}ElectionConfig.max_incidence_rad': 1.5},
    'overlap (election)': {f'{_ELECT}ElectionConfig.max_overlap': 1.0},
    'views of other panoramas': {f'{_ELECT}_view': _nothing},
    'thresholds by score': {f'{_ELECT}_THRESHOLD_SHARE': 0.0},
    'sigmas from residuals': {
        f'{_ADJUST}{name}_weight': BEST for name in ('camera', 'place', 'room')
    },
    'stretches of wall': {f'{_ADJUST}hanging_length_m': 10.0},
    'distrust of outliers': {f'{_LEARN}adjustment.solution:_OUTLIER_PROBABILITY': 0.0},
    'tails (adjustment)': {f'{_LEARN}adjustment.solution:_TAIL_SIGMAS': BEST},
    'what sweeps share': {
        f'{_LEARN}reference_area.common_errors:_COMMON': 0.0,
        f'{_LEARN}reference_area.common_errors:_by_papers': lambda panorama, covariance, room: (
            np.zeros((4, 1 + 2 * len(room.papers)))
        ),
    },
    'tilt of the axis': {f'{_LEARN}sweep_pipeline:levelled': lambda mount, *_: (mount, ())},
    'brightness of edges': {f'{_LEARN}reference_area.edges:_SAME_PX': 0.0},
    'gamma of edges': {f'{_LEARN}reference_area.edges:_GAMMA_STEP': 1e-9},
    'corners of papers': {f'{_LEARN}reference_area.fit:_CORNER_PX': 0.0},
}
DRIVING: dict[str, dict[str, Any]] = {
    'virtual views': {
        f'{_FIND}detection.appearance:textures': lambda landmark, _: [
            Texture(landmark.patch.astype(np.float32), 1.0)
        ]
    },
    'one peak (detection)': {
        f'{_FIND}detection.expectation:DetectionConfig.max_second_ratio': 1.0
    },
    'wrong heights': {f'{_FIND}detection.rows:_WRONG': BEST},
    'blur of the image': {f'{_FIND}detection.correlation:_LOOKS': 1},
    'no measured blur': {
        f'{_FIND}detection.correlation:_BLURRIEST_PX2': 0.0,
        f'{_FIND}detection.correlation:_SHARPEST_PX2': 0.0,
    },
    'what blur mixes in': {f'{_FIND}detection.correlation:_BLURRED_IN': 0.0},
    'choice by information': {
        f'{_FIND}observer:most_informative': lambda axis, m, index, s, count, n: index[:count]
    },
    'novelty': {f'{_FIND}observer:_NEW': 1.0},
    'fewer while most are found': {f'{_FIND}observer:_MOST': 2.0},
    'search where it was turned': {f'{_FIND}observer:_HARDLY_ANY': -1.0},
    'observation area': {
        f'{_FIND}triplet.visibility:TripletConfig.min_sampling': 0.01,
        f'{_FIND}triplet.visibility:TripletConfig.max_sampling': 100.0,
    },
    'jitter of odometry': {f'{_FIND}odometry.track:_SIGNIFICANT': BEST},
    'a given start is doubted': {f'{_FIND}fusion:_GIVEN_RIGHT': BEST},
    'unlikely mounts': {f'{_FIND}fusion:_MAY_STEP': {}},
}
# As DRIVING, but the place is found from nothing.
SEARCHING: dict[str, dict[str, Any]] = {
    'two tolerances of votes': {f'{_FIND}relocalization.search:_FINE_RAD': 0.07},
    'further candidates': {f'{_FIND}relocalization.search:_ALL_CANDIDATES': 4},
    'any one may be mistaken': {f'{_FIND}relocalization.search:_MOST_RISK': BEST},
    'camera tilt (search)': {
        f'{_FIND}relocalization.search:RelocalizationConfig.tilt_sigma_rad': 0.0
    },
    'roll of the camera': {f'{_FIND}relocalization.verification:_LEAST_SURE': BEST},
    'within a wide prior': {f'{_FIND}observer:is_prior_uncertain': lambda covariance: False},
}


def put(target, value):
    """Put a value in place of ``module:NAME`` or the default of ``module:Class.field``."""
    module, name = target.split(':')
    owner = import_module(module)
    kind, _, field = name.partition('.')
    if not field:
        getattr(owner, name)  # a row about a removed name fails
        setattr(owner, name, value)
        return
    config = getattr(owner, kind)
    assert is_dataclass(config)
    names = [each.name for each in fields(config)]
    defaults = list(config.__init__.__defaults__)
    defaults[names.index(field) - len(names)] = value
    config.__init__.__defaults__ = tuple(defaults)


def run(scene, out, changes, learned, start):
    """Learn, unless a map is given, and drive; the report goes to `out`."""
    for target, value in changes.items():
        put(target, value)
    name, given = 'start.json', {}
    options = ['-q']
    if scene.name.startswith('mrclam'):
        name, learned = 'log_start.json', scene / 'log_map'
        given = {'drive': scene / 'log', 'robot': scene / 'log_robot.yaml'}
        options += ['--config', scene / 'log_config.yaml']
    elif learned is None:
        learned = out.with_suffix('.map')
        learn(scene, learned, '-q')
    given['start'] = start_of(scene, name) if start else None
    evaluate(scene, learned, *options, out=out, **given)


def measured(scene, out, changes, learned=None, start=True):
    """As `run` in a process of its own; what the report says."""
    if not out.exists():
        process = multiprocessing.get_context('fork').Process(
            target=_silently, args=(scene, out, changes, learned, start)
        )
        process.start()
        process.join()
        if process.exitcode:
            return {}
    return dict(json.loads(out.read_text()))


def _silently(*given):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        run(*given)


def numbers(report):
    """RMSE [mm], heading [deg], NEES, undetected failures, landmarks."""
    if not report:
        return np.full(5, np.nan)
    figures = figures_of(report)
    names = ('fused_mm', 'fused_deg', 'nees', 'beyond_5s', 'landmarks')
    return np.array([figures[name] for name in names])


def scenes(rooms):
    yield BAGS
    if STUDY.is_dir():
        yield STUDY
    if not sorted(rooms.glob('room_*')):
        for seed in SEEDS:
            command(
                'simulate', '--out', rooms / f'room_{seed}', '--seed', seed, '--light-change',
                '--exchange', 0.2, '-q',
            )  # fmt: skip
    yield from sorted(rooms.glob('room_*'))
    if (SHARED / 'mrclam').is_dir():
        log = rooms / 'mrclam'
        if not log.is_dir():
            log.mkdir()
            command('convert', 'mrclam', SHARED / 'mrclam', '--robot', 1, '--out', log / 'log')
        yield log


def row(name, values):
    cells = (' / '.join(f'{value:.3g}' for value in each) for each in values)
    return f'| {name} | {" | ".join(cells)} |'


def main():
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('rooms', type=Path, help='folder of rooms and results')
    parser.add_argument('--only', nargs='+', help='rows to measure')
    arguments = parser.parse_args()
    rooms, only = arguments.rooms, arguments.only
    where = list(scenes(rooms))
    results = rooms / 'results'
    results.mkdir(exist_ok=True)
    print('| without | ' + ' | '.join(scene.name for scene in where) + ' |')
    print('|---|' + '---|' * len(where))
    kept: dict[Path, Path] = {}
    for start in (True, False):
        reports = []
        for scene in where:
            out = results / f'{scene.name}_all_{start}.json'
            reports.append(measured(scene, out, {}, kept.get(scene), start))
            if not scene.name.startswith('mrclam'):
                kept.setdefault(scene, results / f'{scene.name}_all_True.map')
        title = 'nothing' if start else 'nothing, place found from nothing'
        print(row(title, [numbers(each) for each in reports]), flush=True)
    tables = [(LEARNING, True, True), (DRIVING, False, True), (SEARCHING, False, False)]
    for table, learns, start in tables:
        for name, changes in table.items():
            if only and name not in only:
                continue
            values = []
            for scene in where:
                if learns and scene.name.startswith('mrclam'):
                    continue
                out = results / f'{scene.name}_{name.replace(" ", "_").replace(",", "")}.json'
                learned = None if learns else kept.get(scene)
                values.append(numbers(measured(scene, out, changes, learned, start)))
            print(row(name, values), flush=True)
    return 0
