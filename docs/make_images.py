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

DOCS = Path(__file__).resolve().parent
BAGS = DOCS.parent / 'bags'
SETUP = ('--room', str(BAGS / 'room.yaml'), '--robot', str(BAGS / 'robot.yaml'))
MOST_BYTES = 200_000

COMMANDS = (
    ('figures', '--out', 'figures'),
    ('learn', str(BAGS / 'learn'), *SETUP, '--out', 'map'),
    ('evaluate', str(BAGS / 'drive'), '--map', 'map', *SETUP[2:], '--out', 'drive'),
    ('demo', '--out', 'demo'),
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
    """Panorama of the demo above, map and drive side by side below."""
    wide, *pair = (
        Image.open(folder / f'{name}.png').convert('RGB')
        for name in ('panorama_1', 'map', 'trajectory')
    )
    height = min(image.height for image in pair)
    pair = [image.resize((image.width * height // image.height, height)) for image in pair]
    width = sum(image.width for image in pair)
    top = wide.resize((width, wide.height * width // wide.width))
    page = Image.new('RGB', (width, top.height + height), 'white')
    page.paste(top, (0, 0))
    page.paste(pair[0], (0, top.height))
    page.paste(pair[1], (pair[0].width, top.height))
    return page


def save_reduced(image: Image.Image, target: Path) -> None:
    """Write an image with at most 1200 columns and 256 colours, and `MOST_BYTES`."""
    width = min(1200, image.width)
    while True:
        size = width, round(image.height * width / image.width)
        image.resize(size, Image.Resampling.LANCZOS).quantize(256, dither=0).save(
            target, optimize=True
        )
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
        save_reduced(demo_page(Path(folder, 'demo')), DOCS / 'images' / 'demo.png')


if __name__ == '__main__':
    main()
