"""The page of one evaluated model: its scores, and its predictions over a few seconds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from forcegp.files import write_text
from forcegp.report.html import Block, render
from forcegp.report.tables import Table, cell
from forcegp.report.window import WindowData, draw_errors, draw_predictions

PAGE, WINDOW = "evaluation.html", "window.json"
FIGURES = ("predictions.svg", "errors.svg")


def write_evaluation(folder: Path, title: str, scores: Mapping[str, object], window: WindowData) -> Path:
    """Write figures, their data and a page on one model.

    Args:
        folder: where the files go.
        title: model and data.
        scores: by name.
        window: predictions over a few seconds of the data.

    Returns:
        The path of the page.
    """
    pictures = (draw_predictions(window), draw_errors(window))
    for name, picture in zip(FIGURES, pictures, strict=True):
        write_text(folder / name, picture.svg)
    write_text(folder / WINDOW, window.to_json())
    block = Block(
        "Predictions and errors",
        "Left: accelerations by joint, measured in black, predicted in colour, with the band of two standard "
        "deviations where the model gives one. Right: the same less the prediction; where the data hold the "
        "noise-free acceleration, that is the black line.",
        pictures,
        WINDOW,
    )
    rows = tuple((name.replace("_", " "), cell(value)) for name, value in scores.items())
    table = Table("Scores on this data set", ("score", "value"), rows)
    write_text(folder / PAGE, render("evaluation.html.j2", title=title, table=table, blocks=(block,)))
    return folder / PAGE
