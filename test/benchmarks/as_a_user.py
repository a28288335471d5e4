"""What checks do as a user would: give commands, learn rooms by them, keep images as bags do."""

from __future__ import annotations

from pathlib import Path
import tempfile

import cv2
import numpy as np

from landmark_nav.cli.main import main as landmark_nav
from landmark_nav.storage.maps import load_map
from landmark_nav.types import ImageArray, LandmarkMap


def command(*words: object) -> None:
    """`landmark-nav` with these words; ends the check if it fails."""
    arguments = [str(word) for word in words]
    status = landmark_nav(arguments)
    if status != 0:
        raise SystemExit(f'landmark-nav {" ".join(arguments)}: exit status {status}')


def learned_room(seed: int, *options: str, kept: Path | None = None) -> LandmarkMap:
    """Map of a simulated room, or of one that `kept` holds already."""
    with tempfile.TemporaryDirectory() as scratch:
        room, out = kept or Path(scratch) / 'room', Path(scratch) / 'map'
        if kept is None:
            command('simulate', '--out', room, '--seed', seed, '--drive-seconds', 1, *options)
        files = ('--room', room / 'room.yaml', '--robot', room / 'robot.yaml')
        command('learn', room / 'learn', *files, '--out', out)
        return load_map(out)


def as_jpeg(image: ImageArray, quality: int = 90) -> ImageArray:
    """What is left of an image in a JPEG."""
    _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8)
