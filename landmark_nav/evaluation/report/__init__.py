"""Report of a run: an interactive page in a single HTML file, and a video."""

from landmark_nav.evaluation.report.collect import (
    calibration_page,
    drive_page,
    learning_page,
    Page,
    panoramas,
)
from landmark_nav.evaluation.report.frames import FrameStrip
from landmark_nav.evaluation.report.video import write_video
from landmark_nav.evaluation.report.write import check_report, write_report
