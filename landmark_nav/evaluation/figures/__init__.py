"""The figures that `learn` and `evaluate` draw."""

from landmark_nav.evaluation.figures.map_figure import draw_map
from landmark_nav.evaluation.figures.panorama_figure import draw_panorama
from landmark_nav.evaluation.figures.run_figures import draw_errors, draw_trajectory
