"""All checks of a bag of a drive or of sweeps, and of the papers in its sweeps."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from landmark_nav.diagnosis.drives import DriveChecks, THOROUGH
from landmark_nav.diagnosis.findings import Delays, Diagnosis, Finding
from landmark_nav.diagnosis.stamps import check_stamps
from landmark_nav.diagnosis.streams import read_stream
from landmark_nav.diagnosis.sweeps import check_sweeps
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep, PanoramaStages
from landmark_nav.storage.bags import Bag, read_sweeps

# Number of images that `learn` and `evaluate` decode at their start.
QUICK = 60
IMAGES = ('camera/image_raw', 'camera/image_raw/compressed')
_SWEEP_IMAGES = ('sweep/image', 'sweep/image/compressed')


def diagnose(
    bag: Bag, mount: PanTiltMount, room: Room | None = None, most_images: int = THOROUGH
) -> Diagnosis:
    """
    Check the streams of a bag of a drive, or of sweeps.

    The size of a `room` determines the unit of the odometry more exactly. `most_images` are
    decoded, more if these show a fault. Raises `LandmarkNavError`: the bag cannot be read at all.
    """
    # Warnings of the readers become findings.
    described: dict[str, None] = {}
    bag = bag.warning_to(lambda text: described.update({text: None}))
    found: list[Finding] = []
    delays = Delays()
    images = _first(bag, IMAGES)
    sweeps = _first(bag, _SWEEP_IMAGES)
    if images:
        diagnosis = DriveChecks(bag, images, mount, room).diagnosis(most_images)
        found += diagnosis.findings
        delays = diagnosis.delays
    elif bag.find('detections'):
        for name in ('detections', 'odom'):
            topic = bag.find(name)
            if topic:
                found += check_stamps(read_stream(bag, name, topic))
    if sweeps:
        checked = check_sweeps(bag, sweeps, mount, most_images)
        if most_images < THOROUGH and any(finding.level == 'error' for finding in checked):
            checked = check_sweeps(bag, sweeps, mount, THOROUGH)
        found += checked
    if not found:
        bag.require(*IMAGES, *_SWEEP_IMAGES)
    for text in described:
        line = text.replace(f'{bag.path}: ', '')
        found.append(Finding('reading', 'warning', line, when_read=True))
    return Diagnosis(tuple(found), delays)


def _first(bag: Bag, names: Iterable[str]) -> str | None:
    return next((topic for name in names if (topic := bag.find(name))), None)


def check_papers(bag: Bag, mount: PanTiltMount, room: Room) -> list[Finding]:
    """Locate each sweep of a bag, if any, by the papers of a room, as `learn` does."""
    found: list[Finding] = []
    if not (bag.find('sweep/image') or bag.find('sweep/image/compressed')):
        return found
    sweeps = read_sweeps(bag, mount)
    while True:
        name = f'papers, sweep {len(found) + 1}'
        try:
            sweep = next(sweeps, None)
            if sweep is None:
                return found
            axis = panorama_from_sweep(sweep, room, mount, PanoramaStages()).axis
        except LandmarkNavError as error:
            text = str(error).removeprefix(f'{bag.path}: ')
            found.append(Finding(name, 'error', text))
            continue
        x, y, heading = axis.pose.tolist()
        sigma = 1e3 * float(np.sqrt(np.trace(axis.covariance[:2, :2])))
        text = f'pan axis at ({x:.2f}, {y:.2f}) m, {np.degrees(heading):.1f} deg'
        text += f' (sigma {sigma:.0f} mm)'
        values = {'pose': [x, y, heading], 'sigma_m': 1e-3 * sigma}
        found.append(Finding(name, 'ok', text, '', values))
