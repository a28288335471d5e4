"""
The recorded room of bags/ and a simulated one, beside the figures that are kept of them.

``python test/benchmarks small`` exits with 1 where a figure is over 5 % worse than in
``baseline.json``; with ``--write`` it keeps what it measures. `make test` runs the same.
"""

import argparse
import json
from pathlib import Path
import tempfile

from harness import BAGS, evaluate, figures_of, learn, SETUPS, start_of
from rooms import run_room

BASELINE = Path(__file__).with_name('baseline.json')
CAMERA = SETUPS / 'camera_quarter_vga.yaml'
SEED = 2718
WORSE = 0.05
# +1 where more is better.
FIGURES = {'fused_mm': -1, 'fused_deg': -1, 'crlb_ratio': -1, 'availability': 1, 'landmarks': 1}

Figures = dict[str, float]


def recorded_room(out):
    """Learn and drive in the room of bags/; `learn.json`, `run.json` and the map stay in `out`."""
    learn(BAGS, out / 'map')
    evaluate(BAGS, out / 'map', '--report', out / 'run.html', start=start_of(BAGS))
    return recorded_figures(out)


def recorded_figures(out):
    """Read what `recorded_room` left."""
    figures = figures_of(json.loads((out / 'run.json').read_text()))
    return {name: figures[name] for name in FIGURES}


def simulated_room(out):
    """Simulate a room with a camera of few pixels, learn it and drive in it."""
    row = run_room(SEED, out, '--camera', str(CAMERA), '--drive-seconds', '20')
    return {name: float(row[name]) for name in FIGURES}


def worse(name, figures):
    """Figures that are over 5 % worse than those kept, one line each."""
    kept: Figures = json.loads(BASELINE.read_text())[name]
    return [
        f'{name}: {figure} {figures[figure]:.4g}, was {kept[figure]:.4g}'
        for figure, sign in FIGURES.items()
        if sign * (figures[figure] - kept[figure]) < -WORSE * kept[figure]
    ]


def main():
    """Print what is worse, or keep what is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--write', action='store_true', help='keep these figures')
    write = parser.parse_args().write
    measured = {}
    for name, measure in (('recorded', recorded_room), ('simulated', simulated_room)):
        with tempfile.TemporaryDirectory() as scratch:
            measured[name] = measure(Path(scratch))
    print(json.dumps(measured, indent=1))
    if write:
        digits = {k: {f: round(v, 4) for f, v in row.items()} for k, row in measured.items()}
        BASELINE.write_text(json.dumps(digits, indent=1) + '\n')
        return 0
    lost = [line for name, figures in measured.items() for line in worse(name, figures)]
    print('\n'.join(lost) or 'nothing is over 5 % worse')
    return int(bool(lost))
