"""Draw the thumbnails of the gallery: run each example script, and reduce its figure.

python docs/figures/gallery.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parents[1] / "examples"
WIDTH, ASPECT = 480, 0.5
"""Pixels across, and height over width; of a figure with a panel for each joint, the first panels remain."""


def main() -> None:
    for script in sorted(EXAMPLES.rglob("*.py")):
        with tempfile.TemporaryDirectory() as folder:
            figure = Path(folder, "figure.png")
            subprocess.run([sys.executable, script, figure], cwd=folder, check=True)
            if not figure.exists():
                continue
            image = Image.open(figure).convert("RGB")
        image = image.crop((0, 0, image.width, min(image.height, round(ASPECT * image.width))))
        image = image.resize((WIDTH, round(WIDTH * image.height / image.width)), Image.Resampling.LANCZOS)
        image.quantize(64).save(HERE / "gallery" / f"{script.stem}.png", optimize=True)


if __name__ == "__main__":
    main()
