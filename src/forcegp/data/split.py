"""Training and test rows of one log: the paper's split, and one that holds out whole stretches of motion.

Neighbouring samples of a trajectory are almost the same point. Where training points are drawn from the
same stretch as the test rows, as in the paper, the test error says how well a model interpolates; held-out
stretches say how well it predicts motion that it has not seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Int
from torch import Tensor

from forcegp.data.dataset import Dataset
from forcegp.data.selection import select_points
from forcegp.errors import DataError


@dataclass(frozen=True, eq=False)
class Split:
    """Rows to train on and rows to test on.

    Attributes:
        train: `(count,)` row numbers in the order of selection.
        test: row numbers, increasing.
        stretches: the held-out stretches as (first row, one past the last).
    """

    train: Int[Tensor, " count"]
    test: Int[Tensor, " rest"]
    stretches: tuple[tuple[int, int], ...] = ()


def complement(rows: Tensor, n: int) -> Tensor:
    """The row numbers below n that are not among `rows`, increasing."""
    keep = torch.ones(n, dtype=torch.bool, device=rows.device)
    keep[rows] = False
    return torch.nonzero(keep)[:, 0]


def split_by_selection(
    data: Dataset,
    count: int,
    *,
    method: str = "farthest",
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Split:
    """The paper's split: training points selected from the whole log, the rest for testing.

    Raises:
        DataError: there are fewer distinct points.
    """
    train = select_points(data, count, method=method, seed=seed, progress=progress)
    return Split(train, complement(train, len(data)))


def split_by_stretches(
    data: Dataset,
    count: int,
    *,
    stretch: float = 3.0,
    fraction: float = 0.2,
    margin: float = 0.0,
    method: str = "farthest",
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Split:
    """Hold out whole stretches of motion, and select training points from the rest only.

    Each trajectory is cut into stretches of equal duration, as close to `stretch` as fits; of all of
    them, a fraction is drawn at random.

    Args:
        data: a log in order of time.
        count: how many training points.
        stretch: duration of a held-out stretch [s].
        fraction: part of the stretches that is held out.
        margin: time beside each held-out stretch from which no training point is taken either [s].
        method: see `select_points`.
        seed: of the draw of stretches (and of a random selection).
        progress: called with the number of points chosen so far.

    Returns:
        Training rows, all rows of the held-out stretches, and the stretches. Rows in a margin, and rows
        outside the stretches that were not selected, are in neither.

    Raises:
        DataError: the log is not in order of time, is too short to be cut, or leaves too few points.
    """
    blocks = _stretches(data, stretch)
    held_count = max(1, round(fraction * len(blocks)))
    if not (0.0 < fraction < 1.0 and margin >= 0.0) or held_count >= len(blocks):
        raise DataError(
            "the log cannot be split into held-out and training stretches",
            expected="a fraction between 0 and 1 that leaves at least one of the stretches, a margin ≥ 0",
            got=f"fraction {fraction}, margin {margin} s, {len(blocks)} stretches of about {stretch} s",
            hint="use shorter stretches or a longer log",
        )
    order = torch.randperm(len(blocks), generator=torch.Generator().manual_seed(seed))
    held = sorted(blocks[i] for i in order[:held_count].tolist())
    test = torch.zeros(len(data), dtype=torch.bool, device=data.device)
    near = torch.zeros_like(test)
    for first, last in held:
        test[first:last] = True
        same = data.segment == data.segment[first]
        near |= same & (data.t >= data.t[first] - margin) & (data.t <= data.t[last - 1] + margin)
    candidates = torch.nonzero(~near)[:, 0]
    train = select_points(data, count, method=method, seed=seed, candidates=candidates, progress=progress)
    return Split(train, torch.nonzero(test)[:, 0], tuple(held))


def _stretches(data: Dataset, stretch: float) -> list[tuple[int, int]]:
    """Row ranges of the trajectories cut into parts of equal duration."""
    if not data.header.ordered:
        raise DataError(
            "held-out stretches need a log in order of time",
            got="points in order of selection",
            hint="split the log before selecting points from it",
        )
    if not 0.0 < stretch < float("inf"):
        raise DataError("the duration of a stretch is not valid", expected="a positive time [s]", got=stretch)
    _, counts = torch.unique_consecutive(data.segment, return_counts=True)
    blocks, first = [], 0
    for rows in counts.tolist():
        t = data.t[first : first + rows]
        duration = (t[-1] - t[0]).item()
        parts = min(max(1, round(duration / stretch)), rows)
        inner = t[0] + torch.arange(1, parts, dtype=t.dtype, device=t.device) * (duration / parts)
        cuts = [0, *torch.searchsorted(t.contiguous(), inner).tolist(), rows]
        blocks += [(first + a, first + b) for a, b in pairwise(cuts) if b > a]
        first += rows
    return blocks
