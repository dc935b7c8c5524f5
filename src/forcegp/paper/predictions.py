"""Figures 4 and 5: predictions of every model over the same few seconds, and their errors."""

from __future__ import annotations

from collections.abc import Sequence

from forcegp.report.html import Block
from forcegp.report.window import WindowData, common_limit, draw_errors, draw_predictions

SOURCE = "stages/figures/window/"


def prediction_blocks(windows: Sequence[WindowData]) -> tuple[Block, Block]:
    """Both figures under their captions."""
    seconds, limit = f"{windows[0].seconds:.1f} s" if windows else "", common_limit(windows)
    predictions = Block(
        "Figure 4: predictions",
        f"Accelerations of all joints over the same {seconds} of held-out motion without training points: "
        f"noisy "
        "measurements in black, predicted mean in colour, with the ±2σ band of models that give one.",
        tuple(draw_predictions(window) for window in windows),
        SOURCE,
    )
    errors = Block(
        "Figure 5: errors of the predictions",
        "The same window less the predicted mean: noise-free acceleration in black, noisy in grey, the "
        "model's "
        f"band in colour. All models at the same scale of ±{limit:.2g} rad/s²; larger values are cut off.",
        tuple(draw_errors(window, limit) for window in windows),
        SOURCE,
    )
    return predictions, errors
