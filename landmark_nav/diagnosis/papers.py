"""Reference papers in recorded sweeps: whether they give the pose of each sweep."""

from __future__ import annotations

import numpy as np

from landmark_nav.diagnosis.findings import Finding
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.sweep_pipeline import panorama_from_sweep, PanoramaStages
from landmark_nav.storage.bags import Bag, read_sweeps


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
