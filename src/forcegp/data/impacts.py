"""Rows near an impact, whose measured accelerations are those of no smooth motion."""

from __future__ import annotations

import torch

from forcegp.data.dataset import Dataset

IMPACT = "impact"
"""Mask by contact, 1 near a switch, as `forcegp import` writes it."""


def without_marked_impacts(data: Dataset) -> Dataset:
    """The rows that no mask `impact.<contact>` marks; all rows of a log without masks.

    Args:
        data: a log in order of time, or a part of one.

    Returns:
        The log without the marked rows, with a step in its provenance if there are any.
    """
    marked = torch.zeros(len(data), dtype=torch.bool, device=data.t.device)
    for mask in data.contact_extras.get(IMPACT, {}).values():
        marked |= mask > 0.0
    count = int(marked.sum())
    if count == 0:
        return data
    return data[torch.nonzero(~marked)[:, 0]].with_step(f"left out {count} rows at impacts")
