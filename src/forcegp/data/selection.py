"""Preparation of a log for learning: selection of points, held-out blocks, outliers, impacts, and noise.

Farthest-point sampling selects a few points that cover the inputs of a log (section 5.3 of the paper). If
training points come from the same parts of the log as the test rows, as in the paper, the test error measures
interpolation. Held-out blocks measure how well unseen motion is predicted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.data.dataset import Dataset
from forcegp.errors import DataError, check_name

INPUTS = ("q", "qd", "tau")
"""Names of the inputs of a regression model."""


def standardized_inputs(data: Dataset) -> Float[Tensor, "n d"]:
    """Return (q, q̇, τ) of each sample with standardized columns. Constant columns become zero."""
    return standardized(torch.cat([getattr(data, name) for name in INPUTS], dim=-1))


def standardized(x: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Scale columns to zero mean and unit variance. Constant columns become zero."""
    centred = x - x.mean(0)
    # Due to rounding, a constant column may vary by a few units in the last place.
    noise = x.abs().amax(0) * torch.finfo(x.dtype).eps * 16.0
    spread = centred.square().mean(0).sqrt()
    return torch.where(spread > noise, centred / spread.where(spread > noise, 1.0), 0.0)


def farthest_points(
    x: Float[Tensor, "n d"],
    count: int,
    *,
    start: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Int[Tensor, " count"]:
    """Select points such that each is the farthest from its predecessors, and return their indices.

    The selection is i_{k+1} = argmax_i min_{j ≤ k} |x_i − x_{i_j}| in Euclidean distance. Ties go to the
    lowest index. The result is therefore deterministic, and its first k entries are the result for k points.
    The cost is O(n d) per point, and memory use is O(n).

    Args:
        x: the points, `(n, d)`.
        count: number of points to select.
        start: index of the first point. The default is that of the point closest to the mean.
        progress: a function called after each point with the number of points selected so far.

    Raises:
        DataError: there are fewer than `count` distinct points, or `start` is out of range.
    """
    n = x.shape[0]
    _check_count(count, n)
    if start is not None and not 0 <= start < n:
        raise DataError("there is no such starting point", expected=f"0 to {n - 1}", got=start)
    x = x.contiguous()
    first = _distance(x, x.mean(0)).argmin() if start is None else torch.tensor(start, device=x.device)
    chosen, nearest = [first], torch.full_like(x[:, 0], torch.inf)
    for number in range(1, count):
        nearest = torch.minimum(nearest, _distance(x, x[chosen[-1]]), out=nearest)
        farthest = nearest.argmax()
        if nearest[farthest] == 0.0:
            raise DataError(f"cannot select {count} distinct points", expected=f"at most {number}", got=count)
        chosen.append(farthest)
        if progress is not None:
            progress(number + 1)
    return torch.stack(chosen)


def _check_count(count: int, n: int) -> None:
    if not 0 < count <= n:
        raise DataError(f"cannot select {count} of {n} points", expected=f"1 to {n}", got=count)


def _distance(x: Tensor, point: Tensor) -> Tensor:
    """Return |x_i − point| from differences, which are accurate for close points, unlike products."""
    return torch.cdist(x, point[None], compute_mode="donot_use_mm_for_euclid_dist")[:, 0]


def select_points(
    data: Dataset,
    count: int,
    *,
    method: str = "farthest",
    seed: int = 0,
    candidates: Tensor | None = None,
    progress: Callable[[int], None] | None = None,
) -> Int[Tensor, " count"]:
    """Return the row numbers of training points, in the order of selection.

    Args:
        data: the log.
        count: number of points.
        method: `"farthest"` (on standardized q, q̇, τ), `"even"` (evenly spaced rows, in order), or
            `"random"` for comparison. Farthest-point selection favours outliers in real logs.
        seed: random seed for `method="random"`.
        candidates: row numbers to select from. The default is all rows.
        progress: a function called with the number of points selected so far.

    Raises:
        ForceGPError: the method is unknown, or there are too few distinct points.
    """
    rows = torch.arange(len(data), device=data.device) if candidates is None else candidates
    if method == "farthest":
        # Scaled by the whole log, so that the metric does not depend on what is held out.
        return rows[farthest_points(standardized_inputs(data)[rows], count, progress=progress)]
    check_name("method of selection", method, ["farthest", "even", "random"])
    _check_count(count, len(rows))
    if method == "even":
        return rows[torch.linspace(0, len(rows) - 1, count, dtype=torch.float64).round().long()]
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
    return rows[order[:count].to(rows.device)]


@dataclass(frozen=True, eq=False)
class Split:
    """Training rows in the order of selection, test rows in increasing order, and held-out row ranges."""

    train: Int[Tensor, " count"]
    test: Int[Tensor, " rest"]
    stretches: tuple[tuple[int, int], ...] = ()


def complement(rows: Tensor, n: int) -> Tensor:
    """Return the row numbers below n that are not in `rows`, in increasing order."""
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
    """Split a log as in the paper. Select training points from the whole log, and test on the rest."""
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
    """Hold out randomly drawn parts of a log, and select training points only from the rest.

    Args:
        data: a log in time order.
        count: number of training points.
        stretch: approximate duration [s] of the equal parts into which each trajectory is divided.
        fraction: fraction of the parts to hold out.
        margin: duration without training points before and after each held-out block [s].
        method: the selection method, as in `select_points`.
        seed: random seed for the held-out blocks and for random selection.
        progress: a function called with the number of points selected so far.

    Returns:
        Training rows, all rows of the held-out blocks, and the row ranges of these blocks. Rows in a margin
        and rows that were not selected are in neither set.

    Raises:
        DataError: the log is not in time order, is too short, or leaves too few points.
    """
    blocks = _stretches(data, stretch)
    held_count = max(1, round(fraction * len(blocks)))
    if not (0.0 < fraction < 1.0 and margin >= 0.0) or held_count >= len(blocks):
        raise DataError(
            "the log cannot be split into held-out and training stretches",
            expected="a fraction between 0 and 1 that leaves stretches for training, and a margin ≥ 0",
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
    """Divide the trajectories into parts of equal duration, and return their row ranges."""
    if not data.header.ordered:
        text = "held-out blocks require a log in time order"
        hint = "split the log before selecting points from it"
        raise DataError(text, got="points in order of selection", hint=hint)
    if not 0.0 < stretch < float("inf"):
        raise DataError("the duration of a stretch is invalid", expected="a positive time [s]", got=stretch)
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


POSSIBLE, APART, COMMON = 1e3, 100.0, 0.99
"""A position, velocity, acceleration or torque that few arms exceed (SI units), and a multiple of the
quantile `COMMON` of all rows."""


def outliers(*columns: Tensor) -> Tensor:
    """Return a mask `(n,)` of rows of a log with an impossible position, velocity, acceleration or torque.

    It exceeds both `POSSIBLE` and `APART` times the quantile of the magnitudes in all other rows.

    Args:
        columns: values `(n, d)` each.
    """
    values = torch.cat(columns, dim=-1)
    mask = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    while int((~mask).sum()) > 1:
        size = values[~mask].abs()
        k = min(math.ceil(COMMON * len(size)), len(size) - 1)
        new = (size > (APART * size.kthvalue(k, dim=0).values).clamp(min=POSSIBLE)).any(-1)
        if not bool(new.any()):
            break
        mask[~mask] = new
    return mask


IMPACT = "impact"
"""Name of the masks that `forcegp import` writes for each contact. They are 1 near a contact change."""


def without_marked_impacts(data: Dataset) -> Dataset:
    """Return the rows that no mask `impact.<contact>` marks, or all rows if there are no masks."""
    marked = torch.zeros(len(data), dtype=torch.bool, device=data.t.device)
    for mask in data.contact_extras.get(IMPACT, {}).values():
        marked |= mask > 0.0
    count = int(marked.sum())
    if count == 0:
        return data
    return data[torch.nonzero(~marked)[:, 0]].with_step(f"excluded {count} rows at impacts")
