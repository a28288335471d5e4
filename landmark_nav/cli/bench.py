"""`landmark-nav bench`: the time of every stage beside a reference, measured in the same run."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
import json
import platform
from statistics import median
import time

import cv2
import numpy as np

from landmark_nav.cli.bench_learning import learning_comparisons
from landmark_nav.cli.bench_localization import localization_comparisons
from landmark_nav.cli.bench_world import Comparison, World
from landmark_nav.cli.lines import progress
from landmark_nav.cli.options import add_json, add_number, within
from landmark_nav.storage.atomic_io import check_writable, write_atomically


@dataclass(frozen=True)
class Row:
    """
    Median seconds of a stage, and of the reference that does a comparable amount of work.

    `p95_s` is what 95 of 100 calls stay below, where a stage does not take the same time in each.
    """

    stage: str
    ours_s: float
    p95_s: float | None
    reference: str
    reference_s: float

    @property
    def ratio(self) -> float:
        """How many times longer the stage takes than its reference."""
        return self.ours_s / self.reference_s

    def __str__(self) -> str:
        """The row of the table."""
        p95 = '' if self.p95_s is None else f'{1e3 * self.p95_s:.4g}'
        return (
            f'{self.stage:<36}{1e3 * self.ours_s:>9.4g}{p95:>9}'
            f'{1e3 * self.reference_s:>9.4g}{self.ratio:>9.2f}  {self.reference}'
        )


_HEADER = f'{"stage":<36}{"ms":>9}{"95 % ms":>9}{"ref ms":>9}{"ratio":>9}  reference'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.description = (
        'Time every stage on simulated data, and beside it, in the same run and on '
        'the same data, a reference. The ratio of the two can be compared between machines.'
    )
    add_json(parser, 'the times')
    add_number(parser, '--seed', within(int, 0, 2**63 - 1), 0, 'N', 'of the simulated data')
    add_number(
        parser,
        '--repeats',
        within(int, 1, 1000),
        7,
        'N',
        'how often, of which the median is taken',
    )


def run(args: argparse.Namespace) -> int:
    """Time, print and write."""
    check_writable(args.json)
    cv2.setNumThreads(1)
    world = World(args.seed)
    comparisons = chain(learning_comparisons(world), localization_comparisons(world))
    rows = [_timed(comparison, args.repeats) for comparison in progress(comparisons, 'timing')]
    print(_HEADER, *rows, sep='\n')
    if args.json:
        document = {
            'schema': 1,
            'machine': platform.machine(),
            'python': platform.python_version(),
            'numpy': np.__version__,
            'opencv': cv2.__version__,
            'stages': [
                {
                    'stage': row.stage,
                    'seconds': row.ours_s,
                    'p95_seconds': row.p95_s,
                    'reference': row.reference,
                    'reference_seconds': row.reference_s,
                    'ratio': row.ratio,
                }
                for row in rows
            ],
        }
        write_atomically(args.json, json.dumps(document, indent=2) + '\n')
    return 0


def _timed(comparison: Comparison, repeats: int) -> Row:
    """Time the two in turn, so that what else the machine does meets both; warm unless once."""
    works = (comparison.ours, comparison.reference)
    if repeats > 1:
        for work in works:
            work()
    ours: list[float] = []
    reference: list[float] = []
    for _ in range(repeats):
        for work, taken in zip(works, (ours, reference), strict=True):
            taken += [_seconds(work) / comparison.count for _ in range(comparison.calls)]
    p95 = float(np.percentile(ours, 95)) if comparison.calls > 1 else None
    return Row(comparison.stage, median(ours), p95, comparison.reference_name, median(reference))


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
