"""
Pose of a sweep from coloured papers at known places.

Blobs in the panorama give hypotheses; the edges of the papers, found to sub-pixel in every frame
that shows them, then select and refine. Livatino and Madsen triangulate the three papers; all
edges together are more accurate, and sizes distinguish wrong correspondences from right ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import describe_coverage
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.least_squares import covariance_of, solve_positive
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.learning.reference_area.blobs import color_blobs, PaperBlobs
from landmark_nav.learning.reference_area.fit import PaperFit, PaperFitter
from landmark_nav.learning.reference_area.markers import fit_markers
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.reference_area.search import find_places, LEAST_PAPERS, papers_in_view
from landmark_nav.types import FloatArray, Sweep

# Least visible part of all papers together, in whole papers.
_LEAST_EVIDENCE = 1.6
_MOST_MISFIT = 6.0
# A pose with this much more cost than one that fits is not tried.
_HOPELESS = 20.0
# Chi-square, with 3 degrees of freedom, at which two poses certainly differ.
_DISAGREEMENT = 35.0
# Yaws that differ by less are equal.
_SAME_YAW_RAD = 0.05
# Standard deviations of height and tilt by which a camera is refused for these, not for papers.
_ANY_HEIGHT_M, _ANY_TILT_RAD = 0.1, 0.05
# Places are distinguished with so many frames a paper.
_QUICK_FRAMES = 2
# Least share of the edges of a paper that must be found, and least share of these that must fit.
_LEAST_SEEN, _LEAST_AGREED = 0.2, 0.7
# Least deviation at which a prior is wrong, and least error of the sizes that is reported, sigmas.
WRONG_PRIOR, _SIGNIFICANT_SIZE = 4.0, 3.3
# Greatest difference of the channels of a grey image after JPEG or resampling.
_GREY_SPREAD = 2
# Greatest errors of height and tilt of a measurement with tape and spirit level.
_MOST_M, _MOST_RAD = 0.3, float(np.radians(10.0))


@dataclass(frozen=True, eq=False)
class MountError:
    """
    Approximate error of the given mount: true minus given.

    `rise_m` is that of the height of the camera, `tilt_roll_rad` (2,) that of the pan axis about x
    and y of the base.
    """

    rise_m: float = 0.0
    tilt_roll_rad: FloatArray = field(default_factory=lambda: np.zeros(2))

    def beyond(self, rise_m: float, tilt_rad: float, times: float = 1.0) -> tuple[bool, bool]:
        """Whether height and tilt exceed limits, or some times these."""
        off_level = float(np.hypot(*self.tilt_roll_rad)) > times * tilt_rad
        return abs(self.rise_m) > times * rise_m, off_level

    @property
    def reasonable(self) -> bool:
        """Whether the error is plausible for a measurement with tape and spirit level."""
        return not any(self.beyond(_MOST_M, _MOST_RAD))


class WrongMountError(LandmarkNavError):
    """Error: the papers show that the given mount is wrong by `found`."""

    def __init__(self, message: str, found: MountError) -> None:
        super().__init__(message)
        self.found = found


@dataclass(frozen=True, eq=False)
class SweepPlace:
    """
    Pose of a sweep.

    `pose_map_base` (3,) is that of the base, `height_m` that of the optical centre, `covariance`
    (4, 4) that of x, y, z, heading. `mount_score` (3,) and `mount_information` (3, 3) are errors
    of height and of the tilt of the pan axis about x and y of the base in information form, by
    papers alone. `warning` is set if sizes and distances of papers contradict each other.
    """

    pose_map_base: FloatArray
    height_m: float
    covariance: FloatArray
    warning: str = ''
    mount_score: FloatArray = field(default_factory=lambda: np.zeros(3))
    mount_information: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


class PaperSearch:
    """Search for the pose at which papers fit a sweep, found in its `view` in the base frame."""

    def __init__(
        self,
        sweep: Sweep,
        view: CylinderImage,
        room: Room,
        mount: PanTiltMount,
        config: ReferenceAreaConfig,
    ) -> None:
        self._sweep, self._view, self._room = sweep, view, room
        self._mount, self._config = mount, config
        self._height_m = optical_height(sweep, mount)
        self._fitter = PaperFitter(sweep, room, mount, config)

    @cached_property
    def _blobs(self) -> list[PaperBlobs]:
        colors = color_blobs(self._view, {paper.color for paper in self._room.papers})
        return [colors[paper.color] for paper in self._room.papers]

    def located(
        self,
        most_sigmas: float = WRONG_PRIOR,
        rough: bool = False,
        near: SweepPlace | None = None,
    ) -> SweepPlace:
        """
        Measure the pose of the sweep, or a `rough` one before the camera is calibrated.

        If the papers fit at the place `near`, no other is searched. In a room without papers,
        markers serve.

        Raises `WrongMountError`: height or tilt of the camera are off by more than `most_sigmas`;
        `LandmarkNavError`: fewer than three papers are in the room or in view, papers do not fit
        the room, or more than one pose fits.
        """
        config, room = self._config, self._room
        if room.markers and not room.papers:
            fit, names = fit_markers(self._view, self._height_m, room, self._mount, config)
            if not rough and fit.misfit > _MOST_MISFIT:
                raise LandmarkNavError(
                    f'the markers do not fit the room ({", ".join(names)}): measure their places '
                    'and sizes again'
                )
        elif len(room.papers) < LEAST_PAPERS:
            raise LandmarkNavError(
                f'the room names {len(room.papers)} reference papers: hang three and list '
                'them in room.yaml, or give the pose of each sweep (sweep/pose)'
            )
        else:
            names = _names(room)
            there = None if near is None else self._fitter.fit(near.pose_map_base)
            fit = self.fit(rough) if there is None or not _fits(there, room) else there
        if not rough:
            _check_prior(fit, names, config, most_sigmas)
        # The misfit inflates the whole covariance, including the part of the prior.
        scatter = max(1.0, fit.misfit)
        of_mount = covariance_of(fit.mount_covariance / scatter)
        prior = np.array([config.height_sigma_m, *[config.horizon_sigma_rad] * 2]) ** -2.0
        return SweepPlace(
            fit.pose_map_base,
            self._height_m + float(fit.mount[0]),
            fit.covariance,
            _size_warning(fit, config),
            of_mount @ fit.mount / scatter,
            (of_mount - np.diag(prior)) / scatter,
        )

    def check_agreement(self, pose_map_base: FloatArray, covariance: FloatArray) -> None:
        """
        Compare a given pose, (3,) and (3, 3), with that by papers, if they are in view.

        Raises `LandmarkNavError`: they disagree.
        """
        try:
            seen = self.located()
        except LandmarkNavError:
            return
        plane = np.ix_([0, 1, 3], [0, 1, 3])
        total = covariance + seen.covariance[plane]
        off = seen.pose_map_base - pose_map_base
        off[2] = wrap_rad(off[2])
        if off @ solve_positive(total, off) <= _DISAGREEMENT:
            return
        # Papers locate the pan axis: if only the heading differs, the mount is wrong.
        mount = self._mount
        axis = mount.axis_pose_map(seen.pose_map_base) - mount.axis_pose_map(pose_map_base)
        if axis[:2] @ solve_positive(total[:2, :2], axis[:2]) <= _DISAGREEMENT:
            yaw = mount.axis_rpy[2]
            degrees = abs(wrap_rad(off[2] + yaw - np.radians(yaw))) < _SAME_YAW_RAD < abs(yaw)
            raise LandmarkNavError(
                'the heading of sweep/pose and the papers disagree by '
                f'{np.degrees(off[2]):+.1f} deg: fix the yaw of pan_axis rpy in robot.yaml, '
                f'now {yaw:g} rad{", which looks like degrees" if degrees else ", or the pose"}'
            )
        raise LandmarkNavError(
            f'sweep/pose and the papers disagree by {100 * np.hypot(off[0], off[1]):.1f} cm and '
            f'{np.degrees(abs(off[2])):.2f} deg, more than their covariances allow: fix the '
            'pose or its covariance, or the papers in room.yaml'
        )

    def fit(self, rough: bool = False) -> PaperFit:
        """
        Fit of all edges at the pose; `LandmarkNavError` with the reason if there is none.

        A `rough` one may have a large misfit: an optical centre off its axis moves the edges.
        """
        fits = self._tried()
        good = sorted((f for f in fits if _fits(f, self._room)), key=lambda f: -_support(f))
        if not good:
            raise self._refusal(fits)
        best = good[0]
        for other in good[1:]:
            away = se2.relative(best.pose_map_base, other.pose_map_base)
            distinct = np.hypot(away[0], away[1]) > 0.1 or abs(away[2]) > 0.05
            if distinct and _support(other) > 0.8 * _support(best):
                raise LandmarkNavError(
                    'the reference papers are ambiguous: '
                    f'({_place_text(best)}) and ({_place_text(other)}) fit alike; '
                    'hang them at unequal distances'
                )
        fit = self._fitter.fit(best.pose_map_base, mount=best.mount, center_m=best.center_m)
        if fit is None or not _fits(fit, self._room, np.inf if rough else _MOST_MISFIT):
            raise self._refusal([fit] if fit else [])
        return fit

    def fits_somewhere(self) -> bool:
        """Whether a few frames fit at some pose."""
        return bool(self._room.papers) and any(_fits(fit, self._room) for fit in self._tried())

    def _tried(self) -> list[PaperFit]:
        """Fits of few frames at poses, in the order of cost, until the rest is hopeless."""
        fits: list[PaperFit] = []
        enough = np.inf
        base = se2.inverse([*self._mount.axis_xyz[:2], 0.0])
        for place in find_places(self._blobs, self._room, self._height_m, self._config):
            if place.cost > enough:
                break
            start = se2.compose(place.axis_pose, base)
            fit = self._fitter.fit(start, _QUICK_FRAMES, place.mount)
            if fit is not None and self._room.contains(fit.pose_map_base[:2]):
                fits.append(fit)
                if _fits(fit, self._room):
                    enough = min(enough, place.cost + _HOPELESS)
        return fits

    def _refusal(self, fits: list[PaperFit]) -> LandmarkNavError:
        config, frames = self._config, self._sweep.frames
        # The noise of a colour camera counts as a colour.
        images = [frame.image for frame in frames]
        if all(i.ndim == 2 or (np.ptp(i, axis=2) <= _GREY_SPREAD).all() for i in images):
            return LandmarkNavError(_WITHOUT_COLOR)
        if config.height_sigma_m < _ANY_HEIGHT_M and all(len(b) for b in self._blobs):
            loose = replace(config, height_sigma_m=_ANY_HEIGHT_M, horizon_sigma_rad=_ANY_TILT_RAD)
            search = PaperSearch(self._sweep, self._view, self._room, self._mount, loose)
            names = _names(self._room)
            try:
                _check_prior(search.fit(), names, config, WRONG_PRIOR)
            except WrongMountError as error:
                return error
            except LandmarkNavError:
                pass
        why = _why_not(self._blobs, fits, self._room, self._are_cut)
        unseen = describe_coverage([f.pan_rad for f in frames], frames[0].camera.half_fov_rad)
        hint = f'papers may be out of what the sweep saw ({unseen}): turn the robot; or else '
        return LandmarkNavError(f'{hint if unseen else ""}{why}')

    def _are_cut(self, axis_xy: FloatArray) -> BoolArray:
        """Whether papers (n,) extend beyond the upper or lower border of the view from a place."""
        center = np.array([paper.center for paper in self._room.papers])
        half = 0.5 * np.array([paper.height for paper in self._room.papers])
        reach = np.linalg.norm(center[:, :2] - axis_xy, axis=1)
        ends = (center[:, 2] - self._height_m + [half, -half]) / reach
        upper, lower = self._view.cylinder.row_of(ends)
        return np.asarray((upper < 0.0) | (lower > self._view.cylinder.height - 1))


def optical_height(sweep: Sweep, mount: PanTiltMount) -> float:
    """Height of the optical centre above the base, mean of the frames, metres."""
    pan = np.array([frame.pan_rad for frame in sweep.frames])
    tilt = np.array([frame.tilt_rad for frame in sweep.frames])
    return float(mount.camera_pose_base(pan, tilt)[1][:, 2].mean())


def _fits(fit: PaperFit, room: Room, most_misfit: float = _MOST_MISFIT) -> bool:
    """Whether enough papers agree and few contradict."""
    measured = _measured_papers(fit)
    wrong = (fit.seen >= 0.5) & (fit.agreed < _LEAST_AGREED)
    expected = np.sum(papers_in_view(fit.pose_map_base[:2], room))
    return bool(
        measured.sum() >= LEAST_PAPERS
        and measured.sum() > 2 * wrong.sum()
        and np.sum((fit.seen * fit.agreed)[measured]) > max(_LEAST_EVIDENCE, 0.4 * expected)
        and fit.misfit < most_misfit
    )


def _support(fit: PaperFit) -> float:
    """Visible part of the papers that agrees, relative to the misfit."""
    return float(np.sum(fit.seen * fit.agreed)) / max(1.0, fit.misfit)


_WITHOUT_COLOR = (
    'reference papers are found by their colour, and the images have none: publish colour '
    'images, or give the pose of each sweep (sweep/pose)'
)


def _measured_papers(fit: PaperFit) -> BoolArray:
    """Whether each paper was found at its given location, (papers,)."""
    return np.asarray((fit.seen >= _LEAST_SEEN) & (fit.agreed >= _LEAST_AGREED))


def _place_text(fit: PaperFit) -> str:
    """Text of a pose."""
    x, y, heading = fit.pose_map_base
    return f'{x:.2f} m, {y:.2f} m, {np.degrees(heading):.0f} deg'


def _check_prior(
    fit: PaperFit, names: Sequence[str], config: ReferenceAreaConfig, most_sigmas: float
) -> None:
    """Raise `LandmarkNavError` if a fit contradicts the priors of the mount or of the papers."""
    found = MountError(float(fit.mount[0]), fit.mount[1:])
    high, off_level = found.beyond(config.height_sigma_m, config.horizon_sigma_rad, most_sigmas)
    if high:
        way = 'higher' if found.rise_m > 0.0 else 'lower'
        raise WrongMountError(
            f'the camera is {100 * abs(found.rise_m):.1f} cm {way} than robot.yaml says, as the '
            'papers show it: measure the height of camera and papers again; if it is meant to '
            'stand higher or lower at times, give pan_axis a larger xyz_sigma',
            found,
        )
    if off_level:
        tilt = tilt_text(found.tilt_roll_rad)
        raise WrongMountError(f'{tilt}: level the robot, or set pan_axis rpy', found)
    hang = np.abs(fit.hang_m).max(axis=1)
    worst = int(np.argmax(hang))
    if hang[worst] > WRONG_PRIOR * max(config.paper_sigma_m, 1e-4):
        raise LandmarkNavError(
            f'papers or markers do not fit together, by {100 * hang[worst]:.1f} cm (at the '
            f'{names[worst]}, but any may be wrong): measure all again, or uncover them and sweep '
            'again if somebody hid a part of one'
        )


def _names(room: Room) -> list[str]:
    return [f'{paper.color} paper' for paper in room.papers]


def tilt_text(tilt_roll_rad: FloatArray) -> str:
    """Text of a tilt (2,) of the pan axis that differs from the given one."""
    roll, pitch = np.degrees(tilt_roll_rad)
    return (
        f'the pan axis tilts by {roll:+.1f} deg about x and {pitch:+.1f} deg about y of the base '
        'from what robot.yaml gives'
    )


def _size_warning(fit: PaperFit, config: ReferenceAreaConfig) -> str:
    """Warning if sizes of papers do not fit their distances: the only test of the room's scale."""
    # Variance of the estimated size, which the prior draws towards the given size, times the
    # scatter of the edges. It vanishes if the papers give no information on the size.
    scatter = max(1.0, fit.misfit)
    variance = max(config.paper_size_sigma**2 - fit.size_sigma**2 / scatter, 1e-12)
    if abs(fit.size) < _SIGNIFICANT_SIZE * np.sqrt(scatter * variance):
        return ''
    share = fit.size * config.paper_size_sigma**2 / variance
    return (
        f'the papers look {100 * abs(share):.1f} % {"larger" if share > 0.0 else "smaller"} than '
        'given beside the distances between them: measure both again, all of room.yaml may be '
        f'too {"large" if share > 0.0 else "small"} by so much'
    )


def _why_not(
    blobs: list[PaperBlobs],
    fits: list[PaperFit],
    room: Room,
    are_cut: Callable[[FloatArray], BoolArray],
) -> str:
    """Message if no pose was found: expected papers, found blobs or edges, and advice."""
    missing = [p.color for p, b in zip(room.papers, blobs, strict=True) if not len(b)]
    expected = ', '.join(p.color for p in room.papers)
    if missing:
        return (
            f'reference papers not found: {", ".join(missing)} of {expected}; '
            'see that they hang in view and in light'
        )
    if fits:
        best = max(fits, key=lambda fit: float(np.sum(fit.seen * (fit.agreed > 0.95))))
        in_view, fitting = papers_in_view(best.pose_map_base[:2], room), _measured_papers(best)
        cut = are_cut(best.pose_map_base[:2]) & in_view & ~fitting
        each = []
        for k, paper in enumerate(room.papers):
            seen, agreed = 100 * best.seen[k], 100 * best.agreed[k]
            words = f'shows {seen:.0f} % of its edges, {agreed:.0f} % of them fit'
            if fitting[k] or not in_view[k]:
                words = 'fits' if fitting[k] else 'is out of view'
            each.append(f'{paper.color} {"is cut by the image border" if cut[k] else words}')
        remedy = 'uncover the papers, or check colours, sizes and places in room.yaml'
        if cut.any():
            remedy = 'hang them nearer to the height of the camera, or sweep farther away'
        elif (fitting | ~in_view).all():
            remedy = (
                'not all together: check sizes and places of the papers in room.yaml, and how the '
                'pan axis stands in robot.yaml'
            )
        return (
            f'no place in the room fits the papers; at the nearest, ({_place_text(best)}), '
            f'{", ".join(each)}: {remedy}'
        )
    counted = ', '.join(f'{len(b)} {p.color}' for p, b in zip(room.papers, blobs, strict=True))
    return (
        f'no place in the room fits the blobs found ({counted}): '
        'see that nobody hides the papers, or check their colours, sizes and places in room.yaml, '
        'and the mount in robot.yaml'
    )
