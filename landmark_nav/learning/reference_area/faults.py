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
from scipy.special import chdtri

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.learning.least_squares import covariance_of, Equations, levenberg_marquardt
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.learning.reference_area.blobs import color_blobs, PaperBlobs
from landmark_nav.learning.reference_area.edges import outline_blobs, PaperOutlines
from landmark_nav.learning.reference_area.location import MountError, tilt_text
from landmark_nav.learning.reference_area.model import (
    linearized,
    MEASURED,
    OF_PAPER,
    PaperPlaces,
    ReferenceAreaConfig,
)
from landmark_nav.learning.reference_area.search import (
    find_places,
    LEAST_PAPERS,
    PaperPlace,
    papers_in_view,
)
from landmark_nav.types import FloatArray

# State: x, y, heading, roll and pitch of the pan axis of each view; then the values common to all;
# then those of each paper, `OF_PAPER`.
_VIEW, _OF_ALL = 5, ('camera_height', 'sizes', 'focal')
_COMMON, _PAPER = len(_OF_ALL), len(OF_PAPER)
# Sigmas of a free value: m, rad, relative.
_FREE_M, _FREE_RAD, _FREE_SHARE = 0.5, 0.2, 0.5
_IN_METRES = ('camera_height', 'along', 'height', 'depth')
# Faults of the mount -> the sigma that they set free.
_OF_MOUNT = {'camera_height': 'height_sigma_m', 'tilt': 'horizon_sigma_rad'}
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


@dataclass(frozen=True, eq=False)
class PaperView:
    """Sheets in one panorama by colour; `eye_height_m` is that of the optical centre as given."""

    outlines: dict[str, PaperOutlines]
    eye_height_m: float

    @classmethod
    def of(cls, view: CylinderImage, room: Room, eye_height_m: float) -> PaperView:
        """Measure the sheets in a panorama in the base frame; places of papers are not used."""
        outlines = {}
        for color, blobs in color_blobs(view, {paper.color for paper in room.papers}).items():
            papers = [paper for paper in room.papers if paper.color == color]
            near = np.any([_may_be(blobs, p, room, eye_height_m) for p in papers], axis=0)
            outlines[color] = outline_blobs(view, color, blobs.only(near))
        return cls(outlines, eye_height_m)


@dataclass(frozen=True)
class PaperFault:
    """
    One value of ``room.yaml``, ``robot.yaml`` or ``camera_info`` that is wrong.

    `kind` is, of the paper with index `paper`: 'along' (to the left), 'height', 'depth' (off the
    wall), 'width', 'tallness', 'size' (both), 'turned' (both exchanged) or 'hidden'; of all, with
    `paper` -1: 'swapped' (colours), 'mirrored', 'feet' (the unit), 'camera_height', 'tilt'
    (of the pan axis), 'focal' or 'sizes'.
    `value` and `sigma` are true minus given in m, rad or relative, 0 if `kind` is sufficient.
    `text` is its description, `mount` the error of the mount.
    """

    kind: str
    paper: int
    value: float
    sigma: float
    text: str
    mount: MountError | None = None


@dataclass(frozen=True, eq=False)
class PaperFaults:
    """
    Whether papers fit, and the single faults that explain it if not.

    `faults`, the likeliest first, explain the data equally well; if there are none though `fits`
    is false, no single fault does.
    """

    fits: bool
    faults: tuple[PaperFault, ...] = ()

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
        text = ', or '.join(fault.text for fault in self.faults[:2])
        if len(self.faults) > 1:
            return f'{text}; the sweeps fit both: measure both'
        return f'{text}: measure again and fix it' if text else ''


class PaperRecord:
    """Papers in the last sweeps of one room, which are tested together."""

    def __init__(self, room: Room) -> None:
        self._room = room
        self._views: list[PaperView] = []

    def __len__(self) -> int:
        """Return the number of sweeps."""
        return len(self._views)

    def add(self, view: CylinderImage, eye_height_m: float) -> None:
        """Add a panorama in the base frame, with the height of its optical centre."""
        if len(self._room.papers) < LEAST_PAPERS:
            return
        seen = PaperView.of(view, self._room, eye_height_m)
        # A sweep without any sheet, such as one in the dark, says nothing of where they hang.
        if any(map(len, seen.outlines.values())):
            self._views = [*self._views[1 - _MOST_VIEWS :], seen]

    def clear(self) -> None:
        """Drop all sweeps: they were measured with another mount."""
        self._views.clear()

    def faults(self) -> PaperFaults:
        """Faults of the papers; by the last sweep alone if all together give none."""
        faults = paper_faults(self._views, self._room)
        if faults.fits or faults.faults or len(self) < 2:
            return faults
        alone = paper_faults(self._views[-1:], self._room)
        return alone if alone.faults else faults


def _may_be(blobs: PaperBlobs, paper: Paper, room: Room, eye_height_m: float) -> BoolArray:
    """Whether blobs (n,) would be inside the room if they were a paper of about this height."""
    low, high = room.bounds
    far = _ANY_SIZE * float(np.hypot(*(high - low)))
    highest = _ANY_SIZE * max(wall.height for wall in room.walls)
    bottom, top = blobs.edges[:, 2:].T
    reach = paper.height / np.maximum(top - bottom, 1e-6)
    above = eye_height_m + reach * 0.5 * (bottom + top)
    return np.asarray((reach < far) & (above > _BELOW_M) & (above < highest))


def paper_faults(views: Sequence[PaperView], room: Room) -> PaperFaults:
    """
    Compare papers in one panorama or more, each at an unknown pose, with ``room.yaml``.

    The last four are used. They fit if too little is visible for a test, or in the room.
    """
    if len(room.papers) < LEAST_PAPERS or not views:
        return PaperFaults(True)
    views = views[-_MOST_VIEWS:]
    trial = _Trial(views, room)
    as_given = trial.solve(_Hypothesis(''))
    # Without two papers that fit, another order of colours may still explain the data.
    cost = as_given.cost if as_given else _MISSING * len(views) * len(room.papers)
    redundancy = as_given.redundancy if as_given else 1
    if cost <= chdtri(redundancy, _SUSPECT):
        return PaperFaults(True)
    tried = [(hypothesis, trial.solve(hypothesis)) for hypothesis in _hypotheses(room)]
    found = [(hypothesis, solution) for hypothesis, solution in tried if solution]
    found.sort(key=lambda pair: pair[1].cost)
    if not found or cost - found[0][1].cost < _REAL_GAIN:
        return PaperFaults(not found or bool(cost <= chdtri(redundancy, _FALSE_ALARM)))
    best = found[0][1]
    if best.missing or best.cost > _EXPLAINED * chdtri(best.redundancy, _FALSE_ALARM):
        return PaperFaults(False)
    alike = [pair for pair in found if pair[1].cost < best.cost + _LEAD]
    return PaperFaults(False, tuple(_fault(*pair, room) for pair in alike))


@dataclass(frozen=True, eq=False)
class _Solution:
    """Chi-square of a hypothesis, its free values (means over views), papers `missing` in view."""

    cost: float
    values: FloatArray
    sigmas: FloatArray
    redundancy: int
    missing: int


@dataclass(frozen=True)
class _Hypothesis:
    """A single fault: a value that is free, a paper that is hidden, or another room."""

    kind: str
    paper: int = -1
    room: Room | None = None

    def free(self, views: int) -> list[int]:
        """Indices in the state of a model with this number of views."""
        if self.kind == 'tilt':
            return [_VIEW * v + n for v in range(views) for n in (3, 4)]
        if self.kind in _OF_ALL:
            return [_VIEW * views + _OF_ALL.index(self.kind)]
        if self.kind in OF_PAPER:
            return [_VIEW * views + _COMMON + _PAPER * self.paper + OF_PAPER.index(self.kind)]
        return []

    @property
    def sigma(self) -> float:
        """Sigma of the free values."""
        if self.kind == 'tilt':
            return _FREE_RAD
        return _FREE_M if self.kind in _IN_METRES else _FREE_SHARE


def _hypotheses(room: Room) -> Iterator[_Hypothesis]:
    """All single faults."""
    papers = room.papers
    for kind in (*_OF_ALL, 'tilt'):
        yield _Hypothesis(kind)
    for k, paper in enumerate(papers):
        for kind in (*OF_PAPER, 'hidden'):
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
    # Round the room counter-clockwise, in a mirror too.
    order = slice(None, None, 1 if x > 0.0 else -1)
    walls, papers = [], []
    for wall in room.walls[order]:
        start, end = [(x * at[0], yz * at[1]) for at in (wall.start, wall.end)][order]
        walls.append(replace(wall, start=start, end=end, height=yz * wall.height))
    for paper in room.papers:
        center = (x * paper.center[0], yz * paper.center[1], yz * paper.center[2])
        width, height = yz * paper.width, yz * paper.height
        papers.append(replace(paper, center=center, width=width, height=height))
    return replace(room, walls=tuple(walls), papers=tuple(papers))


class _Trial:
    """Fits hypotheses to the papers in panoramas."""

    def __init__(self, views: Sequence[PaperView], room: Room) -> None:
        self._views, self._room = views, room
        self._places = [list(_places(view, room)) for view in views]

    def solve(self, hypothesis: _Hypothesis) -> _Solution | None:
        """Fit all views, each at its best pose; None if no view shows enough papers."""
        room, places, k = hypothesis.room or self._room, self._places, hypothesis.paper
        if hypothesis.room and k < 0:
            places = [list(_places(view, room)) for view in self._views]
        elif hypothesis.kind in _OF_MOUNT:
            wide = replace(MEASURED, **{_OF_MOUNT[hypothesis.kind]: hypothesis.sigma})
            places = [
                [*each, *_places(view, room, wide)]
                for view, each in zip(self._views, places, strict=True)
            ]
        elif hypothesis.kind == 'hidden':
            others = np.arange(len(room.papers)) != k
            places = [[replace(p, blob=np.where(others, p.blob, -1)) for p in ps] for ps in places]
        views, chosen = [], []
        for view, each in zip(self._views, places, strict=True):
            each = [place for place in each if np.sum(place.blob >= 0) >= _LEAST_SEEN]
            if each:
                costs = [self._fit(hypothesis, [view], [place], room).cost for place in each]
                views.append(view)
                chosen.append(each[int(np.argmin(costs))])
        if not views:
            return None
        solution = self._fit(hypothesis, views, chosen, room)
        unlocated = len(room.papers) * (len(places) - len(views))
        cost, missing = solution.cost + _MISSING * unlocated, solution.missing + unlocated
        return replace(solution, cost=cost, missing=missing)

    def _fit(
        self,
        hypothesis: _Hypothesis,
        views: Sequence[PaperView],
        places: Sequence[PaperPlace],
        room: Room,
    ) -> _Solution:
        """Least squares with priors."""
        model = _Model(views, places, room)
        prior = model.prior_sigma()
        free = hypothesis.free(len(views))
        prior[free] = hypothesis.sigma
        start = np.zeros(len(prior))
        for v, place in enumerate(places):
            start[_VIEW * v : _VIEW * v + 3] = place.axis_pose

        def with_prior(state: FloatArray) -> Equations:
            residuals, jacobian = model.linearized(state)
            residuals = np.append(residuals, (state - start) / prior)
            jacobian = np.vstack([jacobian, np.diag(1.0 / prior)])
            return float(residuals @ residuals), jacobian.T @ residuals, jacobian.T @ jacobian

        state, cost, information = levenberg_marquardt(with_prior, start)
        unseen = 0
        for place in places:
            missing = papers_in_view(place.axis_pose[:2], room) & (place.blob < 0)
            if hypothesis.kind == 'hidden':
                cost += _HIDDEN
                missing[hypothesis.paper] = False
            unseen += int(np.sum(missing))
        cost += _MISSING * unseen + _BY_FREEDOM * len(free)
        # Those of each view have a common mean.
        width = 2 if hypothesis.kind == 'tilt' else 1
        values = state[free].reshape(-1, width)
        mean = values.sum(0) / max(1, len(values))
        sigmas = np.sqrt(np.diag(covariance_of(information))[free]).reshape(-1, width)
        redundancy = max(1, model.measured - 3 * len(views) - len(free))
        return _Solution(cost, mean, sigmas[:1].sum(0), redundancy, unseen)


def _places(
    view: PaperView, room: Room, config: ReferenceAreaConfig = MEASURED
) -> Iterator[PaperPlace]:
    """Yield possible poses of a panorama, by all papers and by all but one."""
    seen: set[tuple[int, ...]] = set()
    papers = room.papers
    for left_out in (-1, *range(len(papers))):
        kept = [k for k in range(len(papers)) if k != left_out]
        fewer = replace(room, papers=tuple(papers[k] for k in kept))
        blobs = [view.outlines[paper.color] for paper in fewer.papers]
        for place in find_places(blobs, fewer, view.eye_height_m, config)[:_MOST_PLACES]:
            outline = np.full(len(papers), -1)
            outline[kept] = place.blob
            for k in np.flatnonzero(outline < 0):
                outline[k] = _elsewhere(view, room, place.axis_pose, int(k))
            if (key := tuple(outline.tolist())) not in seen:
                seen.add(key)
                yield replace(place, blob=outline)


def _elsewhere(view: PaperView, room: Room, axis_pose: FloatArray, k: int) -> int:
    """Index of the outline that may be paper `k` at a wrong location; -1 for none."""
    found = view.outlines[room.papers[k].color]
    if not len(found) or not papers_in_view(axis_pose[:2], room)[k]:
        return -1
    mount = np.array([view.eye_height_m, 0.0, 0.0])
    given = PaperPlaces.of(room).outlines(axis_pose[None], mount[None])[k]
    reach = float(np.hypot(*(np.asarray(room.papers[k].center[:2]) - axis_pose[:2])))
    # Azimuth, tangent.
    off, seen = found.edges - given, found.edges.reshape(-1, 2, 2)
    moved = reach * wrap_rad(off.reshape(-1, 2, 2).mean(-1))
    larger = np.ptp(seen, axis=-1) / np.ptp(given.reshape(2, 2), axis=-1) - 1.0
    cost = np.sum((moved / _SEARCH_M) ** 2 + (larger / _SEARCH_SHARE) ** 2, 1) + found.misfit
    best = int(np.argmin(cost))
    return best if cost[best] < _MOST_COST else -1


class _Model:
    """Model of the outlines at chosen places, `measured` values, as functions of the state."""

    def __init__(
        self, views: Sequence[PaperView], places: Sequence[PaperPlace], room: Room
    ) -> None:
        self._views, self._papers = len(views), len(room.papers)
        self._view, self._paper = np.nonzero(np.array([place.blob for place in places]) >= 0)
        self._given = PaperPlaces.of(room).chosen(self._paper)
        pairs = zip(self._view.tolist(), self._paper.tolist(), strict=True)
        found = [(views[v].outlines[room.papers[k].color], places[v].blob[k]) for v, k in pairs]
        self._seen = np.array([outlines.edges[n] for outlines, n in found])
        self._sigma = _SCATTER * np.array([outlines.sigma[n] for outlines, n in found])
        self.measured = self._seen.size
        self._eye = np.array([view.eye_height_m for view in views])[self._view]

    def prior_sigma(self) -> FloatArray:
        """Prior sigmas (n,) of the state about its start."""
        tilt, paper = MEASURED.horizon_sigma_rad, MEASURED.paper_sigma_m
        views = np.tile([1e2, 1e2, 1e2, tilt, tilt], self._views)
        common = [MEASURED.height_sigma_m, MEASURED.paper_size_sigma, _FOCAL_SIGMA]
        own = [*[paper] * 3, *[_OWN_SIZE_SIGMA] * 3]
        return np.concatenate([views, common, np.tile(own, self._papers)])

    def linearized(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (4 m,) of the outlines at a state (n,) in sigmas, and their Jacobian."""
        predicted, slopes = linearized(self._predicted, state)
        off = self._seen - predicted.reshape(-1, 4)
        off[:, :2] = wrap_rad(off[:, :2])
        sigma = self._sigma.ravel()
        return off.ravel() / sigma, -slopes.T / sigma[:, None]

    def _predicted(self, states: FloatArray) -> FloatArray:
        """Predicted outlines (..., 4 m) at states (..., n)."""
        lead, split = states.shape[:-1], _VIEW * self._views
        view = states[..., :split].reshape(*lead, -1, _VIEW)[..., self._view, :]
        rise, size, focal = np.moveaxis(states[..., split : split + _COMMON, None], -2, 0)
        errors = states[..., split + _COMMON :].reshape(*lead, -1, _PAPER)[..., self._paper, :]
        mount = np.concatenate([(self._eye + rise)[..., None], view[..., 3:]], -1)
        seen = self._given.outlines(view[..., :3], mount, errors, size)
        # The focal length scales angles about the middles of frames.
        azimuth, scale = seen[..., :2].mean(-1, keepdims=True), 1.0 + focal[..., None]
        seen[..., :2] = azimuth + scale * (seen[..., :2] - azimuth)
        seen[..., 2:] *= scale
        return seen.reshape(*lead, -1)


# Descriptions of faults without a value; of others, with the word for a positive value and for a
# negative one.
_ALONE = {
    'mirrored': 'the papers hang in mirrored order: on the opposite wall of where room.yaml has '
    'them, or its plan is mirrored',
    'feet': 'room.yaml seems to be in feet: its lengths are metres',
    'turned': 'width and height of the {} paper seem exchanged in room.yaml',
    'hidden': 'the {} paper is hidden, of another colour, or far from where room.yaml has it',
}
_WORDS = {
    'along': ('hangs {} further {}', 'left', 'right'),
    'height': ('hangs {} {}', 'higher', 'lower'),
    'depth': ('hangs {} further {}', 'into the room', 'out of the room'),
    'width': ('is {} {}', 'wider', 'narrower'),
    'tallness': ('is {} {}', 'taller', 'less tall'),
    'size': ('is {} {}', 'larger', 'smaller'),
    'sizes': (
        'the papers are {} {} than in room.yaml, unlike their distances',
        'larger',
        'smaller',
    ),
    'camera_height': ('the camera is {} {} than robot.yaml gives', 'higher', 'lower'),
    'focal': ('the focal length in camera_info is {} too {}', 'small', 'large'),
}
# What an exchange of the first and third channel makes of red and blue.
_OF_CHANNELS = {('red', 'blue'), ('blue', 'red')}


def _fault(hypothesis: _Hypothesis, solution: _Solution, room: Room) -> PaperFault:
    """Fault of a hypothesis, with its size and its description."""
    kind, k, mount = hypothesis.kind, hypothesis.paper, None
    largest = int(np.argmax(np.abs(solution.values)))
    value, sigma = float(solution.values[largest]), float(solution.sigmas[largest])
    color = room.papers[k].color
    if sum(paper.color == color for paper in room.papers) > 1:
        x, y, _ = room.papers[k].center
        color = f'{color} ({x:.2f}, {y:.2f})'
    if kind == 'tilt':
        text, mount = tilt_text(solution.values), MountError(tilt_roll_rad=solution.values)
    elif kind == 'swapped' and hypothesis.room is not None:
        both = zip(hypothesis.room.papers, room.papers, strict=True)
        pairs = {(h.color, p.color): None for h, p in both if h.color != p.color}
        other = ', '.join(f'{hangs} where {given} should hang' for hangs, given in pairs)
        # An encoding of bgr8 for rgb8 does that, too.
        images = ', or red and blue of the images,' if pairs.keys() <= _OF_CHANNELS else ''
        text = f'the papers{images} seem swapped, {other}'
    elif kind in _ALONE:
        text = _ALONE[kind].format(color)
    else:
        unit = 'cm' if kind in _IN_METRES else '%'
        amount = f'{100.0 * abs(value):.1f} +- {100.0 * sigma:.1f} {unit}'
        words, more, less = _WORDS[kind]
        text = words.format(amount, less if value < 0.0 else more)
        if k >= 0:
            text = f'the {color} paper {text} than room.yaml gives'
        if kind == 'camera_height':
            mount = MountError(value)
    return PaperFault(kind, k, value, sigma, text, mount)
