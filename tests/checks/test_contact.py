"""Labels of contacts judged by the path of the tip."""

from __future__ import annotations

import numpy as np
import pytest

import forcegp
from forcegp.checks import Log
from forcegp.checks.contact import Path, _labels
from forcegp.data.fields import DataHeader

DT, SLIDES, LEAVES = 1 / 240, 240, 48
"""Sampling period, rows that slide, and rows after them that take off or go on sliding."""
TABLE = forcegp.SurfaceContact("table", "tool", (0, 0, 0), forcegp.Plane((0, 0, 1), 0.0))


def kinds_of(take_off: float) -> list[str]:
    """Findings on a tip that slides with a jitter of 0.1 mm and then leaves with an acceleration [m/s²].

    It is labelled open from where it may leave.
    """
    random, rows = np.random.default_rng(0), SLIDES + LEAVES
    time, zero = DT * np.arange(rows), np.zeros((rows, 1))
    t = np.maximum(time - DT * SLIDES, 0.0)
    v = np.column_stack([0.1 + 2.0 * t, 0.0 * t, take_off * t + 2e-4 * random.normal(size=rows)])
    height = 0.5 * take_off * t**2 + 1e-4 * random.normal(size=rows)
    p = np.column_stack([np.cumsum(v[:, 0]) * DT, 0.0 * t, height])
    closed, segment = time < DT * SLIDES, np.zeros(rows, np.int64)
    log = Log(time, *[zero] * 4, segment, {"table": closed}, ("j",), DataHeader())
    path = Path(height, p, v, np.tile([0.0, 0.0, 1.0], (rows, 1)))
    found = _labels(TABLE, path, closed, np.ones(rows, bool), height, log)
    return [finding.kind for finding in found]


@pytest.mark.parametrize("acceleration", [0.05, 0.15, 1.0])
def test_a_tip_that_takes_off_gently_was_labelled_rightly(acceleration: float) -> None:
    assert kinds_of(acceleration) == []


def test_a_tip_that_slides_on_is_found() -> None:
    assert kinds_of(0.0) == ["contact-missed"]


def test_a_masked_impact_does_not_end_a_label_that_starts_too_early() -> None:
    """A tip comes down from 5 mm while labelled closed; the rows at which it lands are masked."""
    rows, lands, speed = SLIDES, 24, 0.05
    time, zero = DT * np.arange(rows), np.zeros((rows, 1))
    falls = np.arange(rows) < lands
    height = np.where(falls, speed * DT * (lands - np.arange(rows)), 0.0)
    v = np.column_stack([np.full(rows, 0.1), np.zeros(rows), -speed * falls])
    p = np.column_stack([np.cumsum(v[:, 0]) * DT, 0.0 * time, height])
    path = Path(height, p, v, np.tile([0.0, 0.0, 1.0], (rows, 1)))
    usable = ~np.isin(np.arange(rows), [lands - 1, lands])
    label = {"table": np.ones(rows, bool)}
    log = Log(time, *[zero] * 4, np.zeros(rows, np.int64), label, ("j",), DataHeader(), masked=~usable)
    (finding,) = _labels(TABLE, path, usable, usable, height, log)
    assert finding.kind == "contact-early" and finding.intervals == ((0, lands),)
