"""Time stamps: restarts, gaps, steps back, repeated and held rows; streams of different rates."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from forcegp.errors import DataError
from forcegp.logs.clock import drop_repeated, even_clock, find_held, join_stream, split_trajectories
from forcegp.logs.mapping import DerivativesSection
from forcegp.logs.smoothing import add_derivatives, impact_mask
from forcegp.logs.table import ImportReport, Signals


def signals(t: NDArray[np.float64], **vectors: NDArray[np.float64]) -> Signals:
    n = len(t)
    values = {"q": np.sin(t)[:, None], "tau": np.cos(3.0 * t)[:, None]} | vectors
    return Signals(("a",), t.copy(), np.arange(n), np.zeros(n, np.int64), values)


def split(s: Signals, gap: float | None = None) -> ImportReport:
    report = ImportReport("log")
    split_trajectories(s, gap, report)
    return report


def test_a_clock_that_restarts_begins_a_trajectory() -> None:
    t = np.concatenate([np.arange(50), np.arange(30), np.arange(-100, -60)]) * 0.01
    s = signals(t)
    report = split(s)
    assert np.bincount(s.segment).tolist() == [50, 30, 40]
    assert report.findings[0].kind == "restart" and report.findings[0].rows == ((50, 50), (80, 80))


def test_a_step_back_within_a_trajectory_is_an_error_with_its_rows() -> None:
    t = np.arange(60) * 0.01
    q = np.sin(t)[:, None]
    t[40], t[50:52] = t[38], t[45]
    with pytest.raises(DataError, match=r"runs backward in rows 40, 50(?s:.*)0.39 s in row 40(?s:.*)0.38 s"):
        split(signals(t, q=q))


def test_rows_out_of_order_are_sorted_and_named() -> None:
    """The positions show that rows were swapped, and not the clock set back."""
    t = np.arange(60) * 0.01
    order = np.r_[:20, 21, 20, 22:40, 42, 43, 40, 41, 44:60]
    s = signals(t[order], q=np.sin(t)[order, None])
    report = split(s)
    assert s.t.tolist() == t.tolist()
    assert s.vectors["q"][:, 0].tolist() == np.sin(t).tolist()
    assert s.row.tolist() == np.argsort(order).tolist()
    (found,) = report.findings
    assert found.kind == "order"
    assert "3 rows were out of order" in found.message
    assert s.segment.max() == 0


def test_gaps_begin_a_trajectory() -> None:
    t = np.arange(60) * 0.01
    t[20:] += 0.03
    t[40:] += 0.06
    s = signals(t)
    assert split(s).findings[0].rows == ((40, 40),) and s.segment.max() == 1
    s = signals(t)
    split(s, gap=0.02)
    assert s.segment.max() == 2


def test_repeated_rows_are_dropped_and_conflicting_ones_refused() -> None:
    t = np.arange(20) * 0.1
    t = np.sort(np.concatenate([t, t[[5, 9]]]))
    s, report = signals(t), ImportReport("log")
    drop_repeated(s, report)
    assert len(s) == 20 and report.findings[0].rows == ((6, 6), (11, 11))
    wrong = signals(t)
    wrong.vectors["tau"][6] += 1.0
    with pytest.raises(DataError, match="row 6: the time stamp of the row before"):
        drop_repeated(wrong, report)


@pytest.mark.parametrize("drop", [False, True])
def test_held_rows_are_found(drop: bool) -> None:
    s, report = signals(np.arange(30) * 0.1), ImportReport("log")
    for values in s.vectors.values():
        values[11:13] = values[10]
    s.vectors["q"][20] = s.vectors["q"][19]  # at rest the torque goes on: not held
    find_held(s, drop, report)
    assert report.findings[0].rows == ((11, 12),) and len(s) == (28 if drop else 30)


def test_a_slower_stream_is_interpolated_and_rows_without_it_dropped() -> None:
    s, report = signals(np.arange(0.0, 10.0, 0.01)), ImportReport("log")
    t = np.concatenate([np.arange(1.0, 5.0, 0.1), np.arange(6.0, 9.0, 0.1)])
    join_stream(s, "wrench", t, np.column_stack([t] * 6), None, report)
    np.testing.assert_allclose(s.vectors["wrench"][:, 0], s.t, atol=1e-12)
    assert (
        s.t[0] == 1.0 and not ((s.t > 4.91) & (s.t < 5.99)).any() and np.unique(s.segment).tolist() == [1, 2]
    )
    assert report.findings[0].kind == "uncovered"
    with pytest.raises(DataError, match="no row at the times"):
        join_stream(s, "wrench", t + 100.0, np.ones((len(t), 6)), None, report)


def test_an_uneven_clock_is_made_even_to_fourth_order() -> None:
    random = np.random.default_rng(0)
    t = np.sort(np.arange(400) * 0.01 + 0.002 * random.standard_normal(400).clip(-2, 2))
    s, report = signals(t), ImportReport("log")
    even_clock(s, None, report)
    assert np.ptp(np.diff(s.t)) < 1e-12 and report.findings[0].kind == "jitter"
    # 5/384 h⁴ |q⁗| of a cubic spline with h = 0.018 s; 1/8 h² |τ″| linearly, with |τ″| = 9.
    np.testing.assert_allclose(s.vectors["q"][:, 0], np.sin(s.t), atol=1e-8)
    np.testing.assert_allclose(s.vectors["tau"][:, 0], np.cos(3.0 * s.t), atol=4e-4)


def test_contact_switches_and_trajectories_cut_what_is_differentiated() -> None:
    """On either side of a kink q̈ is exact, which no window across it can give."""
    t = np.arange(200) * 0.01
    q = np.where(t < 1.0, t**2, 1.0 + 2.0 * (t - 1.0) - 3.0 * (t - 1.0) ** 2)[:, None]
    s, report = signals(t, q=q), ImportReport("log")
    s.contact["table"] = t >= 1.0
    settings = DerivativesSection(window=11, order=3)
    std = add_derivatives(s, settings, report)
    expected = np.where(t < 1.0, 2.0, -6.0)
    # Rounding of q, 1e-16, over dt².
    np.testing.assert_allclose(s.vectors["qdd"][:, 0], expected, atol=1e-9)
    assert std is not None and std.shape == (200, 1)
    mask = impact_mask(s, 0.055)["table"]
    assert np.flatnonzero(mask).tolist() == list(range(95, 106))


def test_stretches_that_are_too_short_are_dropped_and_reported() -> None:
    t = np.arange(100) * 0.01
    s, report = signals(t), ImportReport("log")
    s.contact["table"] = (t > 0.395) & (t < 0.455)
    add_derivatives(s, DerivativesSection(), report)
    assert report.findings[0].rows == ((40, 45),) and len(s) == 94 and s.segment.max() == 1


def test_a_clock_is_not_resampled_to_far_more_rows_than_were_read() -> None:
    s = signals(np.arange(60) * 0.01)
    with pytest.raises(DataError, match=r"too many rows on an even clock(?s:.*)100,000(?s:.*)590,000,000"):
        even_clock(s, 1e-9, ImportReport("log"))
