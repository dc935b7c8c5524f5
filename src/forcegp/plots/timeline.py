"""Where samples stand on the time axis: segments one after another, with gaps left open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
GAP = 3.0
"""A step longer than so many median steps interrupts a curve."""


@dataclass(frozen=True)
class Timeline:
    """Positions of samples on the time axis.

    Attributes:
        x: `(n,)` time, increasing [s].
        order: `(n,)` row of each position.
        breaks: positions before which a curve is interrupted.
        ordered: whether the samples are a time series, which is drawn as a curve.
        label: of the axis.
    """

    x: Array
    order: NDArray[np.int64]
    breaks: NDArray[np.int64]
    ordered: bool
    label: str

    @classmethod
    def of(cls, t: Tensor, segment: Tensor | None = None, ordered: bool = True) -> Timeline:
        """Place samples on the time axis.

        Args:
            t: `(n,)` [s].
            segment: `(n,)` trajectory of each sample; default one. Segments whose times overlap are placed
                one after another.
            ordered: whether the rows follow time within each segment.
        """
        x, own = as_array(t), np.zeros(len(t)) if segment is None else as_array(segment)
        order = np.arange(len(x)) if ordered else np.lexsort((x, own))
        x, own = x[order], own[order]
        steps, changes = np.diff(x), np.diff(own) != 0
        typical = float(np.median(steps[~changes])) if len(steps[~changes]) else 0.0
        joined = bool((steps[changes] <= 0).any())
        if joined:
            shift = np.where(changes, typical - steps, 0.0)
            x = x + np.concatenate([[0.0], np.cumsum(shift)])
        breaks = np.flatnonzero(changes | (steps > GAP * typical)) + 1
        label = "time, segments one after another [s]" if joined else "time [s]"
        return cls(x, order, breaks, ordered, label)

    def place(self, values: Tensor) -> Array:
        """Values `(n, …)` in the order of the axis."""
        return as_array(values)[self.order]

    def open(self, values: Array) -> Array:
        """Placed values `(n,)` with a NaN where a curve is interrupted."""
        return np.insert(values, self.breaks, np.nan)

    def spans(self, closed: Tensor) -> list[tuple[float, float]]:
        """Times between which a flag `(n,)` is true; none where the samples are no time series."""
        flags = as_array(closed)[self.order] > 0
        if not self.ordered or not len(flags):
            return []
        cuts = np.unique(np.concatenate([[0], np.flatnonzero(np.diff(flags)) + 1, self.breaks, [len(flags)]]))
        pairs = zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)
        return [(float(self.x[a]), float(self.x[b - 1])) for a, b in pairs if flags[a]]


def as_array(values: Any) -> Array:
    """A tensor on any device as an array of double precision."""
    return torch.as_tensor(values).detach().to("cpu", torch.float64).numpy()
