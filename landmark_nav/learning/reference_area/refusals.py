"""Why papers give no place: what was expected, what was seen, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.reference_area.blobs import PaperBlobs
from landmark_nav.learning.reference_area.fit import PaperFit
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.reference_area.search import papers_in_view
from landmark_nav.types import FloatArray, ImageArray

# What a person may be off by; more is another mistake.
_MOST_M, _MOST_RAD = 0.3, float(np.radians(10.0))


@dataclass(frozen=True, eq=False)
class MountError:
    """
    How much higher the camera is than given, and how its pan axis tilts, about.

    `tilt_roll_rad` (2,) is about x and y of the base.
    """

    rise_m: float = 0.0
    tilt_roll_rad: FloatArray = field(default_factory=lambda: np.zeros(2))

    @property
    def reasonable(self) -> bool:
        """Whether a person with a tape and a spirit level may be off by it."""
        return abs(self.rise_m) < _MOST_M and float(np.hypot(*self.tilt_roll_rad)) < _MOST_RAD


class WrongMountError(LandmarkNavError):
    """Papers fit a mount that is off by `found` from the given one."""

    def __init__(self, message: str, found: MountError) -> None:
        super().__init__(message)
        self.found = found


# Shares of a paper's edges: what must be found of it, and what of that must fit.
_LEAST_SEEN, LEAST_AGREED = 0.2, 0.7
# In standard deviations: beyond that a prior is wrong, and sizes of papers are questioned.
WRONG_PRIOR, _SIGNIFICANT_SIZE = 4.0, 3.3
# A grey image comes back from JPEG or resampling with channels that differ by so much.
_GREY_SPREAD = 2


WITHOUT_COLOR = (
    'reference papers are found by their colour, and the images have none: publish colour '
    'images, or give the pose of each sweep (sweep/pose)'
)


def is_grey(image: ImageArray) -> bool:
    """Whether an image, grey or BGR, shows no colour at all; noise of a colour camera does."""
    return image.ndim == 2 or bool((np.ptp(image, axis=2) <= _GREY_SPREAD).all())


def measured_papers(fit: PaperFit) -> npt.NDArray[np.bool_]:
    """Which papers were found where they should hang, (papers,)."""
    return np.asarray((fit.seen >= _LEAST_SEEN) & (fit.agreed >= LEAST_AGREED))


def place_text(fit: PaperFit) -> str:
    """A place in words."""
    x, y, heading = fit.pose_map_base
    return f'{x:.2f} m, {y:.2f} m, {np.degrees(heading):.0f} deg'


def check_prior(
    fit: PaperFit, room: Room, config: ReferenceAreaConfig, most_sigmas: float
) -> None:
    """`LandmarkNavError` if what was taken as nearly known turns out to be wrong."""
    high = abs(fit.rise_m) > most_sigmas * config.height_sigma_m
    leans = np.hypot(*fit.tilt_rad) > most_sigmas * config.horizon_sigma_rad
    if high or leans:
        found = MountError(fit.rise_m, fit.tilt_rad)
        raise WrongMountError(wrong_height(fit.rise_m) if high else wrong_lean(fit), found)
    hang = np.abs(fit.hang_m).max(axis=1)
    worst = int(np.argmax(hang))
    if hang[worst] > WRONG_PRIOR * max(config.paper_sigma_m, 1e-4):
        raise LandmarkNavError(
            f'the papers do not fit together, by {100 * hang[worst]:.1f} cm (at the '
            f'{room.papers[worst].color} one, but any may be wrong): measure all again, or '
            'uncover the papers and sweep again if somebody hid a part of one'
        )


def wrong_lean(fit: PaperFit) -> str:
    """What to do about a pan axis that leans from what is given."""
    roll, pitch = np.degrees(fit.tilt_rad)
    return (
        f'the pan axis tilts by {roll:+.1f} deg about x and {pitch:+.1f} deg about y of the '
        'base from what robot.yaml says, as the papers show it: level the robot, or set '
        'pan_axis rpy'
    )


def size_warning(fit: PaperFit, config: ReferenceAreaConfig) -> str:
    """
    Warning if papers do not look as large as given beside the distances between them.

    A room that is given too large as a whole, papers and all, shows in nothing else.
    """
    # Variance of a size that the prior drew towards what was given; where edges scatter more than
    # they should, so does it. Papers that say next to nothing of it leave it where it was.
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


def wrong_height(rise_m: float) -> str:
    """What to do about a camera that stands higher than given."""
    return (
        f'the camera is {100 * abs(rise_m):.1f} cm {"higher" if rise_m > 0.0 else "lower"} than '
        'robot.yaml says, as the papers show it: measure the height of camera and papers again; '
        'if it is meant to stand higher or lower at times, set reference_area.height_sigma_m'
    )


def why_not(blobs: list[PaperBlobs], fits: list[PaperFit], room: Room) -> str:
    """What was expected, what was seen, and what to do."""
    missing = [p.color for p, b in zip(room.papers, blobs, strict=True) if not len(b.misfit)]
    expected = ', '.join(p.color for p in room.papers)
    if missing:
        return (
            f'reference papers not found: {", ".join(missing)} of {expected}; '
            'see that they hang in view and in light'
        )
    if fits:
        best = max(fits, key=lambda fit: float(np.sum(fit.seen * (fit.agreed > 0.95))))
        in_view = papers_in_view(best.pose_map_base[:2], room)
        each = ', '.join(
            f'{paper.color} '
            + (
                'fits'
                if measured
                else 'is out of view'
                if not seen_from
                else f'shows {100 * seen:.0f} % of its edges, {100 * agreed:.0f} % of them fit'
            )
            for paper, measured, seen_from, seen, agreed in zip(
                room.papers, measured_papers(best), in_view, best.seen, best.agreed, strict=True
            )
        )
        alone = bool((measured_papers(best) | ~in_view).all())
        remedy = (
            'not all together: check sizes and places of the papers in room.yaml, and how the '
            'pan axis stands in robot.yaml'
            if alone
            else 'uncover the papers, or check colours, sizes and places in room.yaml'
        )
        return (
            f'no place in the room fits the papers; at the nearest, ({place_text(best)}), {each}: '
            f'{remedy}'
        )
    counted = ', '.join(
        f'{len(b.misfit)} {p.color}' for p, b in zip(room.papers, blobs, strict=True)
    )
    return (
        f'no place in the room fits the blobs found ({counted}): '
        'see that nobody hides the papers, or check their colours, sizes and places in room.yaml, '
        'and the mount in robot.yaml'
    )
