"""HTML reports and their plots, and functions for building custom pages."""

from forcegp.report.check import write_check
from forcegp.report.page import (
    AXES,
    INK,
    NONE,
    Picture,
    PictureBlock,
    Series,
    Table,
    as_tensor,
    cell,
    colour,
    columns,
    draw,
    label,
    render,
    series,
)
from forcegp.report.rollouts import ModelPath, RolloutData, rollout_data, rollout_section, rollout_table
from forcegp.report.window import WindowData, draw_errors, draw_predictions, predicted_window

__all__ = [
    "AXES",
    "INK",
    "NONE",
    "ModelPath",
    "Picture",
    "PictureBlock",
    "RolloutData",
    "Series",
    "Table",
    "WindowData",
    "as_tensor",
    "cell",
    "colour",
    "columns",
    "draw",
    "draw_errors",
    "draw_predictions",
    "label",
    "predicted_window",
    "render",
    "rollout_data",
    "rollout_section",
    "rollout_table",
    "series",
    "write_check",
]
