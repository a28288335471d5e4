"""
Diagnosis of reference papers that do not fit together: the single fault that explains it.

The data are the outlines of the papers in one panorama or more. The values of ``room.yaml`` and
``robot.yaml`` have a sigma each. A fault is one of these values set free. The fault without which
everything else fits is named, with its size; if several explain the data equally well, all are
named (likelihood ratios, one degree of freedom for each). Sizes of papers give ranges, so that two
papers locate a panorama and the third can be tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Paper, Room, Wall
from landmark_nav.learning.least_squares import covariance_of, levenberg_marquardt
from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.learning.reference_area.blobs import color_blobs, PaperBlobs
from landmark_nav.learning.reference_area.edges import outline_blobs, PaperOutlines
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.reference_area.refusals import MountError
from landmark_nav.learning.reference_area.search import (
    find_places,
    LEAST_PAPERS,
    papers_in_view,
)
from landmark_nav.types import FloatArray

# State: x, y, heading, roll and pitch of the pan axis of each view; then the values common to all:
# height of the camera, size of all papers, focal length; then those of each paper, `_OF_PAPER`.
_VIEW, _OF_ALL = 5, ('camera_height', 'sizes', 'focal')
_OF_PAPER = ('along', 'height', 'depth', 'width', 'tallness', 'size')
_COMMON, _PAPER = len(_OF_ALL), len(_OF_PAPER)
# Sigmas of a free value: m, rad, relative.
_FREE_M, _FREE_RAD, _FREE_SHARE = 0.5, 0.2, 0.5
_IN_METRES = ('camera_height', 'along', 'height', 'depth')
# Faults of the mount -> the sigma that they set free.
_OF_MOUNT = {'camera_height': 'height_sigma_m', 'lean': 'horizon_sigma_rad'}
# Sigmas of the focal length after the calibration by overlaps, and of the sizes of one paper.
_FOCAL_SIGMA, _OWN_SIZE_SIGMA = 1e-3, 3e-3
# Least gain in chi-square of a real fault, and its least lead over all others.
_REAL_GAIN, _LEAD = 25.0, 9.0
# Least gain of a free value (as in Schwarz' criterion).
_BY_FREEDOM = 3.0
# Significance of a misfit without a fault, and of one for which faults are tried; greatest misfit
# with a fault, relative to the limit of the first.
_FALSE_ALARM, _SUSPECT, _EXPLAINED = 1e-4, 0.05, 3.0
# Factor on the sigmas of outlines.
_SCATTER = 1.3
# Fewest papers that locate a panorama.
_LEAST_SEEN = 2
# Costs in each view of a paper that should be in view and is not found, and of one assumed hidden,
# squared sigmas.
_MISSING, _HIDDEN = 60.0, 30.0
# Greatest error of the location of a paper that is searched, m, that of its size, relative, and
# greatest cost of the paper there, squared sigmas.
_SEARCH_M, _SEARCH_SHARE, _MOST_COST = 0.25, 0.15, 12.0
# Largest factor on sizes of papers and rooms, and lowest height of a paper.
_ANY_SIZE, _BELOW_M = 1.6, -0.5
# Most poses tried in a panorama, papers whose colours are permuted, and views.
_MOST_PLACES, _MOST_SWAPPED, _MOST_VIEWS = 4, 4, 4
# Lengths of rooms in feet are plausible in metres too.
_FOOT_M = 0.3048
# Step of numerical differentiation.
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class PaperView:
    """
    Sheets in one panorama, by the colours of a room's papers.

    `eye_height_m` is the height of the optical centre above the floor, as ``robot.yaml`` gives it.
    """

    outlines: dict[str, PaperOutlines]
    eye_height_m: float


@dataclass(frozen=True)
class PaperFault:
    """
    One value of ``room.yaml``, ``robot.yaml`` or ``camera_info`` that is wrong.

    `kind` is, of the paper with index `paper`: 'along' (to the left), 'height', 'depth' (off the
    wall), 'width', 'tallness', 'size' (both), 'turned' (both exchanged) or 'hidden'; of all, with
    `paper` -1: 'swapped' (colours), 'mirrored', 'feet' (the unit), 'camera_height', 'lean'
    (of the pan axis), 'focal' or 'sizes'.
    `value` and `sigma` are true minus given in m, rad or relative, 0 if `kind` is sufficient.
    `gain` is the decrease of chi-square without the fault, `text` its description, `mount` the
    error of the mount.
    """

    kind: str
    paper: int
    value: float
    sigma: float
    gain: float
    text: str
    mount: MountError | None = None


@dataclass(frozen=True, eq=False)
class PaperFaults:
    """
    Whether papers fit, and the single faults that explain it if not.

    `chi_square` and `redundancy` are those without a fault. `faults`, the likeliest first, explain
    the data equally well; if there are none though `fits` is false, no single fault does. `text`
    is a message of one line, empty if all fits.
    """

    fits: bool
    chi_square: float
    redundancy: int
    faults: tuple[PaperFault, ...]

    @property
    def text(self) -> str:
        """What is wrong, and what to do, in one line; empty if all fits."""
        if self.fits or self.faults:
            return self.cause
        return (
            'the papers look otherwise than room.yaml gives them, by more than one error '
            'explains: measure all of them again, and see that nobody hides them'
        )

    @property
    def mount(self) -> MountError | None:
        """The error of the mount, if nothing else explains the papers equally well."""
        blamed = [fault.mount for fault in self.faults]
        return blamed[0] if blamed and None not in blamed else None

    @property
    def cause(self) -> str:
        """The single fault, and what to do, in one line; empty if there is none."""
        if not self.faults:
            return ''
        text = ', or '.join(fault.text for fault in self.faults[:2])
        if len(self.faults) == 1:
            return f'{text}: measure again and fix it'
        return f'{text}; the sweeps fit both: measure both again'


def view_papers(view: CylinderImage, room: Room, eye_height_m: float) -> PaperView:
    """
    Measure the sheets of the papers' colours in the panorama of a sweep.

    Parameters
    ----------
    view : CylinderImage
        Cylinder image in the base frame.
    room : Room
        Room whose papers' colours are used, not their locations.
    eye_height_m : float
        Height of the optical centre, see `optical_height`.
    """
    colors = {paper.color for paper in room.papers}
    found = color_blobs(view, colors)
    outlines = {}
    for color in colors:
        blobs = found[color]
        papers = [paper for paper in room.papers if paper.color == color]
        near = np.any([_may_be(blobs, paper, room, eye_height_m) for paper in papers], axis=0)
        outlines[color] = outline_blobs(view, color, blobs.only(near))
    return PaperView(outlines, eye_height_m)


def _may_be(
    blobs: PaperBlobs, paper: Paper, room: Room, eye_height_m: float
) -> npt.NDArray[np.bool_]:
    """Whether blobs (n,) would be inside the room if they were a paper of about this height."""
    low, high = room.bounds
    far = _ANY_SIZE * float(np.hypot(*(high - low)))
    top = _ANY_SIZE * max(wall.height for wall in room.walls)
    tall = np.maximum(np.abs(np.diff(blobs.tangent, axis=1)[:, 0]), 1e-6)
    reach = paper.height / tall
    above = eye_height_m + reach * blobs.tangent.mean(1)
    return np.asarray((reach < far) & (above > _BELOW_M) & (above < top))


def paper_faults(
    views: Sequence[PaperView], room: Room, config: ReferenceAreaConfig
) -> PaperFaults:
    """
    Compare papers in one panorama or more with ``room.yaml``.

    Parameters
    ----------
    views : sequence of PaperView
        Views of panoramas of one room, each at an unknown pose. The last four are used.
    room : Room
        Walls and papers. Fewer than three papers cannot be tested.

    Returns
    -------
    PaperFaults
        `fits` is true if too little is visible for a test.
    """
    if len(room.papers) < LEAST_PAPERS:
        return _NOTHING
    trial = _Trial(views[-_MOST_VIEWS:], room, config)
    as_given = trial.solve(_Hypothesis(''))
    if as_given is None:
        # Without two papers that fit, another order of colours may still explain the data.
        nothing = np.zeros(0)
        as_given = _Solution(_MISSING * len(views) * len(room.papers), nothing, nothing, 0)
    redundancy = max(as_given.redundancy, 1)
    bound = float(chdtri(redundancy, _FALSE_ALARM))
    if as_given.cost <= float(chdtri(redundancy, _SUSPECT)):
        return PaperFaults(True, as_given.cost, redundancy, ())
    found = []
    for hypothesis in _hypotheses(room):
        solution = trial.solve(hypothesis)
        if solution is not None:
            gain = as_given.cost - solution.cost
            found.append((solution, _fault(hypothesis, solution, gain, room)))
    found.sort(key=lambda pair: pair[0].cost)
    if not found or found[0][1].gain < _REAL_GAIN:
        fits = not found or as_given.cost <= bound
        return PaperFaults(fits, as_given.cost, redundancy, ())
    best = found[0][0]
    if best.missing or best.cost > _EXPLAINED * float(
        chdtri(max(best.redundancy, 1), _FALSE_ALARM)
    ):
        return PaperFaults(False, as_given.cost, redundancy, ())
    alike = tuple(fault for solution, fault in found if solution.cost < best.cost + _LEAD)
    return PaperFaults(False, as_given.cost, redundancy, alike)


_NOTHING = PaperFaults(True, 0.0, 0, ())


class PaperRecord:
    """Papers in the last sweeps of one room, which are tested together."""

    def __init__(self, room: Room, config: ReferenceAreaConfig) -> None:
        self._room, self._config = room, config
        self._views: list[PaperView] = []

    def __len__(self) -> int:
        """Return the number of sweeps."""
        return len(self._views)

    def add(self, view: CylinderImage, eye_height_m: float) -> None:
        """Add a panorama in the base frame, see `view_papers`."""
        if len(self._room.papers) >= LEAST_PAPERS:
            self._views.append(view_papers(view, self._room, eye_height_m))
            del self._views[:-_MOST_VIEWS]

    def clear(self) -> None:
        """Drop all sweeps: they were measured with another mount."""
        self._views.clear()

    def faults(self) -> PaperFaults:
        """Faults of the papers; by the last sweep alone if all together give none."""
        faults = paper_faults(self._views, self._room, self._config)
        if faults.fits or faults.faults or len(self) < 2:
            return faults
        alone = paper_faults(self._views[-1:], self._room, self._config)
        return alone if alone.faults else faults


@dataclass(frozen=True, eq=False)
class _Pick:
    """An approximate pose (3,) of the pan axis, and the outline of each paper, -1 for none."""

    axis_pose: FloatArray
    outline: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Solution:
    """
    Chi-square of a hypothesis, and its free values, means over the views.

    `missing` is the number of papers that should be in view and are not found.
    """

    cost: float
    values: FloatArray
    sigmas: FloatArray
    redundancy: int
    missing: int = 0


@dataclass(frozen=True)
class _Hypothesis:
    """A single fault: a value that is free, a paper that is hidden, or another room."""

    kind: str
    paper: int = -1
    room: Room | None = None

    def free(self, views: int) -> list[int]:
        """Indices in the state of a model with this number of views."""
        if self.kind == 'lean':
            return [_VIEW * v + n for v in range(views) for n in (3, 4)]
        if self.kind in _OF_ALL:
            return [_VIEW * views + _OF_ALL.index(self.kind)]
        if self.kind in _OF_PAPER:
            return [_VIEW * views + _COMMON + _PAPER * self.paper + _OF_PAPER.index(self.kind)]
        return []

    @property
    def width(self) -> int:
        """Number of free values."""
        return 2 if self.kind == 'lean' else 1

    @property
    def sigma(self) -> float:
        """Sigma of the free values."""
        if self.kind == 'lean':
            return _FREE_RAD
        return _FREE_M if self.kind in _IN_METRES else _FREE_SHARE


def _hypotheses(room: Room) -> Iterator[_Hypothesis]:
    """All single faults."""
    papers = room.papers
    for kind in (*_OF_ALL, 'lean'):
        yield _Hypothesis(kind)
    for k, paper in enumerate(papers):
        for kind in (*_OF_PAPER, 'hidden'):
            yield _Hypothesis(kind, k)
        other = (*papers[:k], replace(paper, width=paper.height, height=paper.width))
        yield _Hypothesis('turned', k, replace(room, papers=(*other, *papers[k + 1 :])))
    yield _Hypothesis('mirrored', -1, _redrawn(room, -1.0, 1.0))
    yield _Hypothesis('feet', -1, _redrawn(room, _FOOT_M, _FOOT_M))
    if len(papers) > _MOST_SWAPPED:
        return
    colors = [paper.color for paper in papers]
    for order in sorted(set(permutations(colors)) - {tuple(colors)}):
        hung = (replace(p, color=c) for p, c in zip(papers, order, strict=True))
        yield _Hypothesis('swapped', -1, replace(room, papers=tuple(hung)))


def _redrawn(room: Room, x: float, yz: float) -> Room:
    """Room and papers with their axes scaled; mirrored, papers look as on the opposite wall."""

    def ends(wall: Wall) -> tuple[tuple[float, float], tuple[float, float]]:
        start, end = ((x * at[0], yz * at[1]) for at in (wall.start, wall.end))
        return (end, start) if x < 0.0 else (start, end)

    walls = [
        replace(wall, start=start, end=end, height=yz * wall.height)
        for wall in room.walls
        for start, end in [ends(wall)]
    ]
    papers = [
        replace(
            paper,
            center=(x * paper.center[0], yz * paper.center[1], yz * paper.center[2]),
            width=yz * paper.width,
            height=yz * paper.height,
        )
        for paper in room.papers
    ]
    # Round the room counter-clockwise, in a mirror too.
    return replace(room, walls=tuple(walls[:: 1 if x > 0.0 else -1]), papers=tuple(papers))


class _Trial:
    """Fits hypotheses to the papers in panoramas."""

    def __init__(
        self, views: Sequence[PaperView], room: Room, config: ReferenceAreaConfig
    ) -> None:
        self._views, self._room, self._config = views, room, config
        self._picks = [list(_picks(view, room, config)) for view in views]

    def solve(self, hypothesis: _Hypothesis) -> _Solution | None:
        """Fit all views, each at its best pose; None if no view shows enough papers."""
        room, picks = hypothesis.room or self._room, self._picks
        if hypothesis.kind in ('swapped', 'mirrored', 'feet'):
            picks = [list(_picks(view, room, self._config)) for view in self._views]
        elif hypothesis.kind in _OF_MOUNT:
            wide = replace(self._config, **{_OF_MOUNT[hypothesis.kind]: hypothesis.sigma})
            picks = [
                [*each, *_picks(view, room, wide)]
                for view, each in zip(self._views, picks, strict=True)
            ]
        elif hypothesis.kind == 'hidden':
            k = hypothesis.paper
            picks = [
                [replace(p, outline=(*p.outline[:k], -1, *p.outline[k + 1 :])) for p in each]
                for each in picks
            ]
        views, chosen = [], []
        for view, each in zip(self._views, picks, strict=True):
            each = [pick for pick in each if sum(n >= 0 for n in pick.outline) >= _LEAST_SEEN]
            if each:
                costs = [self._fit(hypothesis, [view], [pick], room).cost for pick in each]
                views.append(view)
                chosen.append(each[int(np.argmin(costs))])
        if not views:
            return None
        solution = self._fit(hypothesis, views, chosen, room)
        unlocated = len(room.papers) * (len(picks) - len(views))
        return replace(
            solution,
            cost=solution.cost + _MISSING * unlocated,
            missing=solution.missing + unlocated,
        )

    def _fit(
        self,
        hypothesis: _Hypothesis,
        views: Sequence[PaperView],
        picks: Sequence[_Pick],
        room: Room,
    ) -> _Solution:
        """Least squares with priors."""
        model = _Model(views, picks, room)
        prior = model.prior_sigma(self._config)
        free = hypothesis.free(len(views))
        prior[free] = hypothesis.sigma
        start = np.zeros(model.size)
        for v, pick in enumerate(picks):
            start[_VIEW * v : _VIEW * v + 3] = pick.axis_pose

        def residuals(states: FloatArray) -> FloatArray:
            return np.concatenate([model.residuals(states), (states - start) / prior], axis=1)

        def linearized(state: FloatArray) -> tuple[FloatArray, FloatArray]:
            here, *moved = residuals(np.vstack([state, state + _STEP * np.eye(model.size)]))
            return here, (np.array(moved) - here).T / _STEP

        state, cost, information = levenberg_marquardt(linearized, start)
        covariance = covariance_of(information)
        unseen, views_without = 0, 0
        for pick in picks:
            missing = papers_in_view(pick.axis_pose[:2], room) & (np.array(pick.outline) < 0)
            if hypothesis.kind == 'hidden':
                views_without += 1
                missing[hypothesis.paper] = False
            unseen += int(np.sum(missing))
        cost += _MISSING * unseen + _HIDDEN * views_without + _BY_FREEDOM * len(free)
        values = state[free]
        if free:
            values = values.reshape(-1, hypothesis.width).mean(axis=0)
        sigmas = np.sqrt(np.diag(covariance)[free[: hypothesis.width]])
        redundancy = model.measured - 3 * len(views) - len(free)
        return _Solution(cost, values, sigmas, redundancy, unseen)


def _picks(view: PaperView, room: Room, config: ReferenceAreaConfig) -> Iterator[_Pick]:
    """Yield possible poses of a panorama, by all papers and by all but one."""
    seen: set[tuple[int, ...]] = set()
    papers = room.papers
    blobs = [_blobs(view.outlines[paper.color]) for paper in papers]
    for left_out in (-1, *range(len(papers))):
        kept = [k for k in range(len(papers)) if k != left_out]
        fewer = replace(room, papers=tuple(papers[k] for k in kept))
        places = find_places([blobs[k] for k in kept], fewer, view.eye_height_m, config)
        for place in places[:_MOST_PLACES]:
            outline = np.full(len(papers), -1)
            outline[kept] = place.blob
            for k in np.flatnonzero(outline < 0):
                outline[k] = _elsewhere(view, room, place.axis_pose, int(k))
            if (key := tuple(outline.tolist())) not in seen:
                seen.add(key)
                yield _Pick(place.axis_pose, key)


def _elsewhere(view: PaperView, room: Room, axis_pose: FloatArray, k: int) -> int:
    """Index of the outline that may be paper `k` at a wrong location; -1 for none."""
    found = view.outlines[room.papers[k].color]
    if not len(found) or not papers_in_view(axis_pose[:2], room)[k]:
        return -1
    alone = tuple(0 if n == k else -1 for n in range(len(room.papers)))
    model = _Model([view], [_Pick(axis_pose, alone)], room)
    state = np.zeros(model.size)
    state[:3] = axis_pose
    right, left, bottom, top = model.predicted(state[None])[0, 0]
    reach = float(np.hypot(*(np.asarray(room.papers[k].center[:2]) - axis_pose[:2])))
    aside = reach * wrap_rad(found.azimuth_rad.mean(1) - 0.5 * (right + left))
    above = reach * (found.tangent.mean(1) - 0.5 * (bottom + top))
    wider = np.diff(found.azimuth_rad)[:, 0] / (left - right) - 1.0
    taller = np.diff(found.tangent)[:, 0] / (top - bottom) - 1.0
    cost = (aside**2 + above**2) / _SEARCH_M**2 + (wider**2 + taller**2) / _SEARCH_SHARE**2
    best = int(np.argmin(cost + found.misfit))
    return best if cost[best] + found.misfit[best] < _MOST_COST else -1


class _Model:
    """
    Model of the picked outlines as functions of the state.

    States come in batches (b, n). `measured` is the number of measured values.
    """

    def __init__(self, views: Sequence[PaperView], picks: Sequence[_Pick], room: Room) -> None:
        self._views, self._papers = len(views), len(room.papers)
        self.size = _VIEW * len(views) + _COMMON + _PAPER * len(room.papers)
        chosen = [
            (v, k, n) for v, pick in enumerate(picks) for k, n in enumerate(pick.outline) if n >= 0
        ]
        self._view = np.array([v for v, _, _ in chosen], np.intp)
        self._paper = np.array([k for _, k, _ in chosen], np.intp)
        papers = [room.papers[k] for k in self._paper]
        seen = [
            (views[v].outlines[p.color], n) for (v, _, n), p in zip(chosen, papers, strict=True)
        ]
        self._seen = np.array([[*found.azimuth_rad[n], *found.tangent[n]] for found, n in seen])
        self._sigma = _SCATTER * np.array([found.sigma[n] for found, n in seen])
        self.measured = self._seen.size
        self._center = np.array([paper.center for paper in papers])
        self._size = np.array([(paper.width, paper.height) for paper in papers])
        wall = room.nearest_wall(self._center[:, :2])
        self._normal = room.normals[wall, :2]
        self._along = np.array([room.walls[int(w)].along for w in wall])
        self._eye = np.array([views[v].eye_height_m for v in self._view])

    def prior_sigma(self, config: ReferenceAreaConfig) -> FloatArray:
        """Prior sigmas (n,) of the state about its start."""
        tilt, paper = config.horizon_sigma_rad, max(config.paper_sigma_m, 1e-4)
        views = np.tile([1e2, 1e2, 1e2, tilt, tilt], self._views)
        common = [config.height_sigma_m, config.paper_size_sigma, _FOCAL_SIGMA]
        own = [*[paper] * 3, *[_OWN_SIZE_SIGMA] * 3]
        return np.concatenate([views, common, np.tile(own, self._papers)])

    def residuals(self, states: FloatArray) -> FloatArray:
        """Residuals (b, 4 m) of the outlines in sigmas."""
        off = self._seen - self.predicted(states)
        off[..., :2] = wrap_rad(off[..., :2])
        return np.asarray(off / self._sigma).reshape(len(states), -1)

    def predicted(self, states: FloatArray) -> FloatArray:
        """Predicted right and left azimuths, bottom and top tangents (b, m, 4)."""
        split = _VIEW * self._views
        x, y, heading, roll, pitch = np.moveaxis(
            states[:, :split].reshape(len(states), -1, _VIEW)[:, self._view], -1, 0
        )
        rise, size, focal = (states[:, split + n, None] for n in range(_COMMON))
        own = states[:, split + _COMMON :].reshape(len(states), -1, _PAPER)[:, self._paper]
        along, up, off, wider, taller, larger = np.moveaxis(own, -1, 0)
        middle = (
            self._center[:, :2] + along[..., None] * self._along + off[..., None] * self._normal
        )
        half = 0.5 * self._size[:, 0] * (1.0 + size + wider + larger)
        level = self._center[:, 2] + up - self._eye - rise
        cos, sin = np.cos(heading), np.sin(heading)
        # The direction along the wall is to the left, as seen from inside the room.
        forward, left, azimuth = [], [], []
        for sign in (-1.0, 1.0):
            end = middle + sign * half[..., None] * self._along
            dx, dy = end[..., 0] - x, end[..., 1] - y
            forward.append(cos * dx + sin * dy)
            left.append(cos * dy - sin * dx)
            # Small rotations of the axis about x and y.
            azimuth.append(np.arctan2(left[-1] + roll * level, forward[-1] - pitch * level))
        # The bisector divides the paper in the ratio of the distances of its ends.
        reach = np.hypot(forward, left)
        share = reach[0] / reach.sum(0)
        ahead = (1.0 - share) * forward[0] + share * forward[1]
        aside = (1.0 - share) * left[0] + share * left[1]
        tilted = level + pitch * ahead - roll * aside
        tall = 0.5 * self._size[:, 1] * (1.0 + size + taller + larger)
        scale = 1.0 + focal
        half_span = 0.5 * scale * wrap_rad(azimuth[1] - azimuth[0])
        center = azimuth[0] + half_span / scale
        tangents = [
            scale * (tilted + sign * tall) / np.hypot(ahead, aside) for sign in (-1.0, 1.0)
        ]
        return np.stack([center - half_span, center + half_span, *tangents], -1)


def _blobs(found: PaperOutlines) -> PaperBlobs:
    """Outlines as blobs, for the search of poses."""
    return PaperBlobs(
        found.azimuth_rad.mean(1),
        np.diff(found.azimuth_rad)[:, 0],
        found.tangent[:, ::-1],
        found.misfit,
    )


def _fault(hypothesis: _Hypothesis, solution: _Solution, gain: float, room: Room) -> PaperFault:
    """Fault of a hypothesis, with its size and its description."""
    kind, k = hypothesis.kind, hypothesis.paper
    value, sigma = (
        float(array[np.argmax(np.abs(solution.values))]) if len(array) else 0.0
        for array in (solution.values, solution.sigmas)
    )
    color = room.papers[k].color
    if sum(paper.color == color for paper in room.papers) > 1:
        x, y, _ = room.papers[k].center
        color = f'{color} ({x:.2f}, {y:.2f})'
    if kind == 'lean':
        roll, pitch = np.degrees(solution.values)
        text = (
            f'the pan axis tilts by {roll:+.1f} deg about x and {pitch:+.1f} deg about y of the '
            'base from what robot.yaml gives'
        )
    elif kind == 'swapped' and hypothesis.room is not None:
        pairs = zip(hypothesis.room.papers, room.papers, strict=True)
        other = [f'{h.color} where {p.color} should hang' for h, p in pairs if h.color != p.color]
        text = f'the papers seem swapped, {", ".join(other)}'
    elif kind == 'mirrored':
        text = (
            'the papers hang in mirrored order: on the opposite wall of where room.yaml has them, '
            'or its plan is mirrored'
        )
    elif kind == 'feet':
        text = 'room.yaml seems to be in feet: its lengths are metres'
    elif kind == 'turned':
        text = f'width and height of the {color} paper seem exchanged in room.yaml'
    elif kind == 'hidden':
        text = (
            f'the {color} paper is hidden, of another colour, or far from where room.yaml has it'
        )
    else:
        amount = f'{100.0 * abs(value):.1f} +- {100.0 * sigma:.1f}'
        amount += ' cm' if kind in _IN_METRES else ' %'
        text = _WORDS[kind][int(value < 0.0)].format(amount)
        if k >= 0:
            text = f'the {color} paper {text} than room.yaml gives'
    return PaperFault(kind, k, value, sigma, gain, text, _mount_error(kind, solution))


def _mount_error(kind: str, solution: _Solution) -> MountError | None:
    """Error of the mount by a fault; None if the fault is not one of the mount."""
    if kind == 'lean':
        return MountError(tilt_roll_rad=solution.values)
    if kind == 'camera_height':
        return MountError(float(solution.values[0]))
    return None


# Descriptions of faults with a positive value, and with a negative one.
_WORDS = {
    'along': ('hangs {} further left', 'hangs {} further right'),
    'height': ('hangs {} higher', 'hangs {} lower'),
    'depth': ('hangs {} further into the room', 'hangs {} further out of the room'),
    'width': ('is {} wider', 'is {} narrower'),
    'tallness': ('is {} taller', 'is {} less tall'),
    'size': ('is {} larger', 'is {} smaller'),
    'sizes': (
        'the papers look {} larger than room.yaml gives beside their distances',
        'the papers look {} smaller than room.yaml gives beside their distances',
    ),
    'camera_height': (
        'the camera is {} higher than robot.yaml gives',
        'the camera is {} lower than robot.yaml gives',
    ),
    'focal': (
        'the focal length of camera_info is {} too small',
        'the focal length of camera_info is {} too large',
    ),
}
