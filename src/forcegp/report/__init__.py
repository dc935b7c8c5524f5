"""HTML pages and their plots.

Programs outside the library, such as the study under `reproduction/`, make their own pages from the names
exported here: plots (`draw` fills a `Picture`), tables, findings, blocks of plots under a caption, and
`render`, which fills a template of the caller's beside the library's own. Predicted accelerations over a
window and trajectories in open loop come as data with a schema and as the plots of these data.
"""

from forcegp.report.check import write_check
from forcegp.report.html import (
    NONE,
    Part,
    PictureBlock,
    Series,
    Statement,
    Table,
    as_tensor,
    cell,
    columns,
    matrix,
    number,
    render,
    series,
)
from forcegp.report.rollout_data import RolloutData, rollout_data, together, with_bands
from forcegp.report.rollouts import rollout_section, rollout_table
from forcegp.report.style import AXES, INK, MARKERS, Picture, colour, draw, label, shade
from forcegp.report.window import WindowData, common_limit, draw_errors, draw_predictions, predicted_window

__all__ = [
    "AXES",
    "INK",
    "MARKERS",
    "NONE",
    "Part",
    "Picture",
    "PictureBlock",
    "RolloutData",
    "Series",
    "Statement",
    "Table",
    "WindowData",
    "as_tensor",
    "cell",
    "colour",
    "columns",
    "common_limit",
    "draw",
    "draw_errors",
    "draw_predictions",
    "label",
    "matrix",
    "number",
    "predicted_window",
    "render",
    "rollout_data",
    "rollout_section",
    "rollout_table",
    "series",
    "shade",
    "together",
    "with_bands",
    "write_check",
]
