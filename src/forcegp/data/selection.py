"""Farthest point sampling: few points that cover the inputs of a log (section 5.3 of the paper)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.data.dataset import Dataset
from forcegp.errors import DataError, UnknownNameError

INPUTS = ("q", "qd", "tau")
"""What a regression model sees of a sample."""


def standardized_inputs(data: Dataset) -> Float[Tensor, "n d"]:
    """(q, q̇, τ) of each sample with zero mean and unit variance a column; constant columns become zero."""
    return standardized(torch.cat([getattr(data, name) for name in INPUTS], dim=-1))


def standardized(x: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Columns with zero mean and unit variance; constant columns become zero."""
    centred = x - x.mean(0)
    # Rounding leaves a constant column a spread of some units in the last place.
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
    """Indices of points each of which is farthest from those before it, by exact Euclidean distance.

    i_{k+1} = argmax_i min_{j ≤ k} |x_i − x_{i_j}|; of equal distances the lowest index wins, so the result
    is deterministic, and the first k of it are the result for k points. O(n d) a point, O(n) memory.

    Args:
        x: `(n, d)` points.
        count: how many to choose.
        start: the first point; default the one closest to the mean.
        progress: called after each point with the number chosen so far.

    Returns:
        `(count,)` indices in the order of selection.

    Raises:
        DataError: there are fewer than `count` distinct points, or no point `start`.
    """
    n = x.shape[0]
    if not 0 < count <= n:
        raise DataError(f"cannot select {count} of {n} points", expected=f"1 to {n}", got=count)
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


def _distance(x: Tensor, point: Tensor) -> Tensor:
    """|x_i − point| by differences: the form by products loses the digits of close points."""
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
    """Row numbers of training points, in the order of selection.

    Args:
        data: the log.
        count: how many points.
        method: `"farthest"` (on standardized q, q̇, τ), `"even"` (evenly spaced rows, in their order), or
            `"random"` for comparison. Farthest points favour outliers, which a measured log has.
        seed: of the random choice; farthest points need none.
        candidates: row numbers to choose from; default all.
        progress: called with the number of points chosen so far.

    Raises:
        UnknownNameError: no such method.
        DataError: there are fewer distinct points.
    """
    rows = torch.arange(len(data), device=data.device) if candidates is None else candidates
    if method == "farthest":
        # Scaled by the whole log, so that the metric does not depend on what is held out.
        return rows[farthest_points(standardized_inputs(data)[rows], count, progress=progress)]
    if method not in ("even", "random"):
        raise UnknownNameError("method of selection", method, ["farthest", "even", "random"])
    if not 0 < count <= len(rows):
        raise DataError(
            f"cannot select {count} of {len(rows)} points", expected=f"1 to {len(rows)}", got=count
        )
    if method == "even":
        return rows[torch.linspace(0, len(rows) - 1, count, dtype=torch.float64).round().long()]
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
    return rows[order[:count].to(rows.device)]
