"""Refusals of the reference area: what was expected, what was found, and what to do."""

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


# Least share of the edges of a paper that must be found, and least share of these that must fit.
_LEAST_SEEN, LEAST_AGREED = 0.2, 0.7
# Least deviation at which a prior is wrong, and least error of the sizes that is reported, sigmas.
WRONG_PRIOR, _SIGNIFICANT_SIZE = 4.0, 3.3
# Greatest difference of the channels of a grey image after JPEG or resampling.
_GREY_SPREAD = 2


WITHOUT_COLOR = (
    'reference papers are found by their colour, and the images have none: publish colour '
    'images, or give the pose of each sweep (sweep/pose)'
)


def is_grey(image: ImageArray) -> bool:
    """Whether an image, grey or BGR, has no colour; the noise of a colour camera counts as one."""
    return image.ndim == 2 or bool((np.ptp(image, axis=2) <= _GREY_SPREAD).all())


def measured_papers(fit: PaperFit) -> npt.NDArray[np.bool_]:
    """Whether each paper was found at its given location, (papers,)."""
    return np.asarray((fit.seen >= _LEAST_SEEN) & (fit.agreed >= LEAST_AGREED))


def place_text(fit: PaperFit) -> str:
    """Text of a pose."""
    x, y, heading = fit.pose_map_base
    return f'{x:.2f} m, {y:.2f} m, {np.degrees(heading):.0f} deg'


def check_prior(
    fit: PaperFit, room: Room, config: ReferenceAreaConfig, most_sigmas: float
) -> None:
    """Raise `LandmarkNavError` if a fit contradicts the priors of the mount or of the papers."""
    found = MountError(float(fit.mount[0]), fit.mount[1:])
    high, off_level = found.beyond(config.height_sigma_m, config.horizon_sigma_rad, most_sigmas)
    if high or off_level:
        tilt = f'{tilt_text(found.tilt_roll_rad)}: level the robot, or set pan_axis rpy'
        raise WrongMountError(wrong_height(found.rise_m) if high else tilt, found)
    hang = np.abs(fit.hang_m).max(axis=1)
    worst = int(np.argmax(hang))
    if hang[worst] > WRONG_PRIOR * max(config.paper_sigma_m, 1e-4):
        raise LandmarkNavError(
            f'the papers do not fit together, by {100 * hang[worst]:.1f} cm (at the '
            f'{room.papers[worst].color} one, but any may be wrong): measure all again, or '
            'uncover the papers and sweep again if somebody hid a part of one'
        )


def tilt_text(tilt_roll_rad: FloatArray) -> str:
    """Text of a tilt (2,) of the pan axis that differs from the given one."""
    roll, pitch = np.degrees(tilt_roll_rad)
    return (
        f'the pan axis tilts by {roll:+.1f} deg about x and {pitch:+.1f} deg about y of the base '
        'from what robot.yaml gives'
    )


def size_warning(fit: PaperFit, config: ReferenceAreaConfig) -> str:
    """
    Return a warning if the sizes of the papers do not fit the distances between them.

    This is the only test for a wrong scale of all lengths of ``room.yaml`` but the sizes.
    """
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


def wrong_height(rise_m: float) -> str:
    """Message for a height of the camera that differs from the given one."""
    return (
        f'the camera is {100 * abs(rise_m):.1f} cm {"higher" if rise_m > 0.0 else "lower"} than '
        'robot.yaml says, as the papers show it: measure the height of camera and papers again; '
        'if it is meant to stand higher or lower at times, give pan_axis a larger xyz_sigma'
    )


def why_not(blobs: list[PaperBlobs], fits: list[PaperFit], room: Room) -> str:
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
        in_view, fitting = papers_in_view(best.pose_map_base[:2], room), measured_papers(best)
        each = []
        for k, paper in enumerate(room.papers):
            seen, agreed = 100 * best.seen[k], 100 * best.agreed[k]
            words = f'shows {seen:.0f} % of its edges, {agreed:.0f} % of them fit'
            if fitting[k] or not in_view[k]:
                words = 'fits' if fitting[k] else 'is out of view'
            each.append(f'{paper.color} {words}')
        remedy = 'uncover the papers, or check colours, sizes and places in room.yaml'
        if (fitting | ~in_view).all():
            remedy = (
                'not all together: check sizes and places of the papers in room.yaml, and how the '
                'pan axis stands in robot.yaml'
            )
        return (
            f'no place in the room fits the papers; at the nearest, ({place_text(best)}), '
            f'{", ".join(each)}: {remedy}'
        )
    counted = ', '.join(f'{len(b)} {p.color}' for p, b in zip(room.papers, blobs, strict=True))
    return (
        f'no place in the room fits the blobs found ({counted}): '
        'see that nobody hides the papers, or check their colours, sizes and places in room.yaml, '
        'and the mount in robot.yaml'
    )
