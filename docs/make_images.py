"""
Figures of the documentation, drawn by the product's own commands: ``make docs-images``.

Runs for about eight minutes and writes ``docs/images``, each file reduced to 200 kB at most.
"""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory

from PIL import Image

from landmark_nav.evaluation.figures.map_figure import draw_map
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_room

DOCS = Path(__file__).resolve().parent
BAGS = DOCS.parent / 'bags'
SETUP = ('--room', str(BAGS / 'room.yaml'), '--robot', str(BAGS / 'robot.yaml'))
MOST_BYTES = 200_000

COMMANDS = (
    ('figures', '--out', 'figures'),
    ('learn', str(BAGS / 'learn'), *SETUP, '--out', 'map'),
    ('evaluate', str(BAGS / 'drive'), '--map', 'map', *SETUP[2:], '--out', 'drive'),
    ('demo', '--out', 'demo'),
    (
        *('evaluate', 'demo/recording', '--map', 'demo/map'),
        *('--robot', 'demo/robot.yaml', '--out', 'demo_drive'),
    ),
)
# What a command writes -> its name in docs/images.
WRITTEN = {
    'figures/figure_3_panoramas.png': 'panoramas.png',
    'figures/figure_4_attention.png': 'attention.png',
    'figures/figure_5_stereo.png': 'stereo.png',
    'figures/figure_6_observation_areas.png': 'observation_areas.png',
    'figures/figure_7_features_alone.png': 'features_alone.png',
    'figures/figure_8_all_features.png': 'all_features.png',
    'map/map.png': 'map.png',
    'drive/trajectory.png': 'trajectory.png',
    'drive/errors.png': 'errors.png',
}


def demo_page(folder: Path) -> Image.Image:
    """Map and drive of the demo, side by side."""
    papers = load_room(folder / 'demo' / 'room.yaml').papers
    draw_map(load_map(folder / 'demo' / 'map'), folder / 'demo_map.png', papers)
    pair = [
        Image.open(folder / name).convert('RGB')
        for name in ('demo_map.png', 'demo_drive/trajectory.png')
    ]
    height = min(image.height for image in pair)
    pair = [image.resize((image.width * height // image.height, height)) for image in pair]
    page = Image.new('RGB', (sum(image.width for image in pair), height), 'white')
    page.paste(pair[0], (0, 0))
    page.paste(pair[1], (pair[0].width, 0))
    return page


def save_reduced(image: Image.Image, target: Path) -> None:
    """Write an image with at most 1200 columns and 256 colours, and `MOST_BYTES`."""
    width = min(1200, image.width)
    while True:
        size = width, round(image.height * width / image.width)
        small = image.resize(size, Image.Resampling.LANCZOS)
        # The default method drops rare colours, as those of thin lines.
        small.quantize(256, Image.Quantize.FASTOCTREE, dither=0).save(target, optimize=True)
        if target.stat().st_size <= MOST_BYTES:
            return
        width = width * 9 // 10


def main() -> None:
    """Run the commands, keep what they draw."""
    with TemporaryDirectory() as folder:
        for command in COMMANDS:
            call = [sys.executable, '-m', 'landmark_nav', *command]
            subprocess.run(call, cwd=folder, check=True)
        for written, name in WRITTEN.items():
            save_reduced(Image.open(Path(folder, written)).convert('RGB'), DOCS / 'images' / name)
        save_reduced(demo_page(Path(folder)), DOCS / 'images' / 'demo.png')


if __name__ == '__main__':
    main()
