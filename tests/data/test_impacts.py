"""Rows at impacts are left out by their mask, and nothing else is."""

from __future__ import annotations

import torch

from forcegp.data import without_marked_impacts
from logs import random_log


def test_rows_that_a_mask_marks_are_left_out() -> None:
    data = random_log(60)
    assert without_marked_impacts(data) is data
    mask = torch.zeros(60, dtype=torch.float64)
    mask[10:14] = 1.0
    marked = data.replace(contact_extras={**data.contact_extras, "impact": {"table": mask}})
    clear = without_marked_impacts(marked)
    assert clear.t.tolist() == [*data.t[:10].tolist(), *data.t[14:].tolist()]
    assert clear.header.provenance[-1] == "excluded 4 rows at impacts"
    assert clear.header.ordered
