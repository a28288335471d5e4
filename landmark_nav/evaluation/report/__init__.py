"""Report of a run: an interactive page in a single HTML file, and a video."""

from landmark_nav.evaluation.report.collect import (
    calibration_page,
    check_report,
    drive_page,
    FrameStrip,
    learning_page,
    Page,
    panoramas,
    write_report,
)
from landmark_nav.evaluation.report.video import write_video
