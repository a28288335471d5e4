"""A sheet of a known size as one panorama shows it: how far it is, its size says."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.types import FloatArray


@dataclass(frozen=True, eq=False)
class SheetView:
    """
    What may be a sheet.

    `kind` is ``papers`` or ``markers``, `name` a colour or a number; `position` (3,) that of its
    middle from the viewpoint, along the axes of the base, metres; `covariance` (3, 3) its own.
    `shared` (3, q) is how q errors that all sheets of a kind have in common move it, each by its
    standard deviation.
    """

    kind: str
    name: str
    position: FloatArray
    covariance: FloatArray
    shared: FloatArray
