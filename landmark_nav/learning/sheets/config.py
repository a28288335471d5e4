"""Parameters of sheets of a known size."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.geometry.walls import paper_bgr
from landmark_nav.parameters import Config, parameter

# Dictionaries of markers as OpenCV names them.
_DICTIONARIES = (
    *(f'DICT_{n}X{n}_{count}' for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    'DICT_ARUCO_ORIGINAL',
    *(f'DICT_APRILTAG_{family}' for family in ('16h5', '25h9', '36h10', '36h11')),
)


@dataclass(frozen=True)
class SheetsConfig(Config):
    """Known sizes of sheets; 0 if there are none of a kind."""

    paper_width_m: float = parameter(
        0.0, 'width of coloured papers that hang upright anywhere', minimum=0, maximum=5
    )
    paper_height_m: float = parameter(0.0, 'their height', minimum=0, maximum=5)
    paper_colors: str = parameter('red green blue', 'their colours')
    marker_size_m: float = parameter(
        0.0, 'side of the black square of markers', minimum=0, maximum=5
    )
    marker_dictionary: str = parameter(
        'DICT_4X4_50', 'dictionary of the markers, as OpenCV names it'
    )
    # Relative sigma of these sizes.
    size_sigma: float = 0.002
    # Sigma of the corners of markers, pixels.
    corner_sigma_px: float = 0.15

    def __post_init__(self) -> None:
        """Check that sizes come in pairs, colours have a hue and the dictionary is known."""
        super().__post_init__()
        if (self.paper_width_m > 0.0) != (self.paper_height_m > 0.0):
            raise LandmarkNavError(
                f'papers of {self.paper_width_m:g} m x {self.paper_height_m:g} m: give both sides'
            )
        if self.marker_dictionary not in _DICTIONARIES:
            raise LandmarkNavError(
                f'marker dictionary {shown(self.marker_dictionary)}: take one that OpenCV has, as '
                'DICT_4X4_50, DICT_6X6_250 or DICT_APRILTAG_36h11'
            )
        for color in self.paper_colors.split():
            paper_bgr(color)

    @property
    def has_papers(self) -> bool:
        """Whether papers of a known size are searched."""
        return self.paper_width_m > 0.0

    @property
    def has_markers(self) -> bool:
        """Whether markers of a known size are searched."""
        return self.marker_size_m > 0.0
