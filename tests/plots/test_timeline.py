"""Where samples stand on the time axis."""

from __future__ import annotations

import numpy as np
import torch

from forcegp.plots import Timeline


def test_segments_whose_time_restarts_follow_one_another() -> None:
    t = torch.tensor([0.0, 0.1, 0.2, 0.0, 0.1])
    time = Timeline.of(t, torch.tensor([0, 0, 0, 1, 1]))
    np.testing.assert_allclose(time.x, [0.0, 0.1, 0.2, 0.3, 0.4], atol=1e-7)
    assert time.breaks.tolist() == [3]
    assert "one after another" in time.label
    opened = time.open(time.place(torch.arange(5.0)))
    np.testing.assert_array_equal(opened, [0.0, 1.0, 2.0, np.nan, 3.0, 4.0])


def test_a_gap_interrupts_a_curve() -> None:
    time = Timeline.of(torch.tensor([0.0, 0.1, 0.2, 1.0, 1.1]))
    assert time.breaks.tolist() == [3] and time.label == "time [s]"


def test_contact_is_shaded_from_its_first_to_its_last_sample() -> None:
    time = Timeline.of(0.1 * torch.arange(8, dtype=torch.float64))
    flags = torch.tensor([0, 1, 1, 0, 0, 1, 0, 1], dtype=torch.bool)
    np.testing.assert_allclose(time.spans(flags), [(0.1, 0.2), (0.5, 0.5), (0.7, 0.7)])


def test_selected_points_are_sorted_and_not_joined() -> None:
    time = Timeline.of(torch.tensor([0.3, 0.1, 0.2]), ordered=False)
    np.testing.assert_array_equal(time.place(torch.tensor([3.0, 1.0, 2.0])), [1.0, 2.0, 3.0])
    assert time.spans(torch.ones(3, dtype=torch.bool)) == []
