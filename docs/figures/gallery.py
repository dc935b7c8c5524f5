"""Draw the thumbnails of the gallery: run each example script, and reduce its figure.

python docs/figures/gallery.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parents[1] / "examples"
WIDTH, ASPECT = 480, 0.5
"""Pixels across, and height over width; of a figure with a panel for each joint, the first panels remain."""
BLANK = 250
"""Brightness above which a pixel is background."""


def whole_panels(image: Image.Image) -> int:
    """Return the height of a thumbnail, which ends below the last whole panel."""
    most = round(ASPECT * image.width)
    if image.height <= most:
        return image.height
    inked = (np.asarray(image.convert("L"))[:most] <= BLANK).any(axis=1)
    bands = np.flatnonzero(np.diff(np.concatenate([[False], inked]).astype(int)))
    # What begins and ends within the limit and is higher than a title is a panel.
    panels = [stop for start, stop in zip(bands[::2], bands[1::2], strict=False) if stop - start > most // 8]
    return int(max(panels, default=most))


def main() -> None:
    for script in sorted(EXAMPLES.rglob("*.py")):
        with tempfile.TemporaryDirectory() as folder:
            figure = Path(folder, "figure.png")
            subprocess.run([sys.executable, script, figure], cwd=folder, check=True)
            if not figure.exists():
                continue
            image = Image.open(figure).convert("RGB")
        image = image.crop((0, 0, image.width, whole_panels(image)))
        image = image.resize((WIDTH, round(WIDTH * image.height / image.width)), Image.Resampling.LANCZOS)
        image.quantize(64).save(HERE / "gallery" / f"{script.stem}.png", optimize=True)


if __name__ == "__main__":
    main()
