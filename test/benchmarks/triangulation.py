"""
The closed form for three bearings beside the same equations in compiled C.

python test/benchmarks triangulation [--count 1000000]

The C follows the paper (Pierlot and Van Droogenbroeck, IEEE T-RO 30(3), 2014): cotangents, the
position alone or with the heading out of one more arc tangent. It is compiled on the spot, so a C
compiler must be there.
"""

from __future__ import annotations

import argparse
import ctypes
from pathlib import Path
import shutil
import subprocess
import tempfile
import time

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.triangulation.model import danger_distance, triangulate_three
from landmark_nav.types import FloatArray

_C = r"""
#include <math.h>

static double cot(double angle)
{
  double value = 1.0 / tan(angle);
  return value > 1e8 ? 1e8 : value < -1e8 ? -1e8 : value;
}

/* landmarks: n x 3 x 2; bearings: n x 3; poses: n x 3 */
void triangulate(
  long n, const double *landmarks, const double *bearings, int heading, double *poses)
{
  for (long i = 0; i < n; ++i) {
    const double *l = landmarks + 6 * i, *b = bearings + 3 * i;
    double *p = poses + 3 * i;
    double xa = l[0] - l[2], ya = l[1] - l[3], xc = l[4] - l[2], yc = l[5] - l[3];
    double t12 = cot(b[1] - b[0]), t23 = cot(b[2] - b[1]);
    double t31 = (1.0 - t12 * t23) / (t12 + t23);
    double x12 = xa + t12 * ya, y12 = ya - t12 * xa;
    double x23 = xc - t23 * yc, y23 = yc + t23 * xc;
    double x31 = xc + xa + t31 * (yc - ya), y31 = yc + ya - t31 * (xc - xa);
    double k31 = xa * xc + ya * yc + t31 * (xa * yc - xc * ya);
    double d = (x12 - x23) * (y23 - y31) - (y12 - y23) * (x23 - x31);
    p[0] = l[2] + k31 * (y12 - y23) / d;
    p[1] = l[3] + k31 * (x23 - x12) / d;
    if (heading) p[2] = atan2(l[3] - p[1], l[2] - p[0]) - b[1];
  }
}
"""


class Reference:
    """The C function."""

    def __init__(self, folder: Path, compiler: str) -> None:
        source, library = folder / 'three.c', folder / 'three.so'
        source.write_text(_C, encoding='utf-8')
        command = [compiler, '-O3', '-shared', '-fPIC', str(source), '-o', str(library), '-lm']
        subprocess.run(command, check=True)
        self._function = ctypes.CDLL(str(library)).triangulate
        pointer = np.ctypeslib.ndpointer(dtype=np.float64, flags='C_CONTIGUOUS')
        self._function.argtypes = [ctypes.c_long, pointer, pointer, ctypes.c_int, pointer]
        self._function.restype = None

    def __call__(self, landmarks: FloatArray, bearings: FloatArray, heading: bool) -> FloatArray:
        """Poses (n, 3)."""
        poses = np.zeros((len(bearings), 3))
        self._function(len(bearings), landmarks, bearings, int(heading), poses)
        return poses


def draw(count: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Landmarks (n, 3, 2) and poses (n, 3) in a room of 8 m, and exact bearings (n, 3)."""
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(-4.0, 4.0, (count, 3, 2))
    poses = rng.uniform([-4.0, -4.0, -np.pi], [4.0, 4.0, np.pi], (count, 3))
    delta = landmarks - poses[:, None, :2]
    return landmarks, poses, wrap_rad(np.arctan2(delta[..., 1], delta[..., 0]) - poses[:, 2:])


def main() -> int:
    """Print times and the largest difference."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--count', type=int, default=1_000_000)
    parser.add_argument('--repeats', type=int, default=7)
    args = parser.parse_args()
    compiler = shutil.which('gcc') or shutil.which('cc')
    if compiler is None:
        print('no C compiler (gcc or cc) on the PATH')
        return 1
    landmarks, poses, bearings = draw(args.count)
    with tempfile.TemporaryDirectory() as folder:
        reference = Reference(Path(folder), compiler)
    works = {
        'C, position': lambda: reference(landmarks, bearings, False),
        'C, position and heading': lambda: reference(landmarks, bearings, True),
        'triangulate_three': lambda: triangulate_three(landmarks, bearings),
    }
    taken: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(args.repeats):
        for name, work in works.items():
            begin = time.perf_counter()
            work()
            taken[name].append(time.perf_counter() - begin)
    best = {name: min(seconds) for name, seconds in taken.items()}
    for name, seconds in best.items():
        print(f'{name:<26}{1e9 * seconds / args.count:8.1f} ns each')
    ours = best['triangulate_three']
    for name in list(works)[:2]:
        print(f'ratio to {name:<26}{ours / best[name]:6.2f}')
    found = triangulate_three(landmarks[:20_000], bearings[:20_000])
    good = np.array(
        [
            danger_distance(p[:2], k)[1] > 0.05
            for p, k in zip(poses, landmarks[:20_000], strict=False)
        ]
    )
    error = np.abs((found - poses[:20_000])[good])
    error[:, 2] = np.abs(wrap_rad(error[:, 2]))
    print(f'{good.sum()} away from the danger circle: largest error {error[:, :2].max():.1e} m, '
          f'{error[:, 2].max():.1e} rad')  # fmt: skip
    return 0
