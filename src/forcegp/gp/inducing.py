"""Greedy selection of inducing points from the data by conditional variance.

Each step adds the sample with the largest residual variance Σ_k S_kk Var(f_k(x) | f(Z)), which appears in the
trace term of the collapsed bound. This is a pivoted partial Cholesky factorisation (Burt, Rasmussen & van der
Wilk 2020). The weights S = WᵀW convert the residual variance to units of the noise variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.gp.basis import KernelPart, split
from forcegp.gp.factor import TRUNCATION
from forcegp.gp.features import Block, Features, points
from forcegp.gp.kernels import Parameters, Process, sub

CANDIDATES = 4000
"""Number of samples from which inducing points are selected."""
LIMIT = 100
"""Maximum number of inducing points per process."""
SHARE = 0.02
"""Ratio of the residual to the posterior variance of all rows at which selection stops. In units of the noise
variance, M basis functions learned from noisy rows have a total posterior variance of at most M over all
rows. The residual variance should be small compared with this.
"""


@dataclass(frozen=True)
class Selection:
    """Selected inducing points of a process.

    Attributes:
        points: kernel inputs of the points.
        missed: residual prior variance `(points + 1,)` of a row given 0, 1, … points, averaged over the
            candidates, in units of the noise variance.
    """

    points: dict[str, Tensor]
    missed: Tensor


@torch.no_grad()
def select_inducing(
    processes: Sequence[Process],
    params: Parameters,
    blocks: Sequence[Block],
    rows: int | None = None,
    limit: int = LIMIT,
    share: float = SHARE,
) -> list[Selection]:
    """Select inducing points for each process from the samples in the blocks.

    Processes that affect no row or that have finitely many features have no inducing points.

    Args:
        rows: total number of rows to condition on; defaults to the number of rows in the blocks.
        limit: maximum number of points per process.
        share: stop when the residual variance is this fraction of the posterior variance of all rows.
    """
    candidate_rows = sum(block.rows for block in blocks)
    tolerance = share / (candidate_rows if rows is None else rows)
    chosen = []
    for p, prior in enumerate(processes):
        names = blocks[0].features[p]
        x = {name: torch.cat([block.features[p][name] for block in blocks]) for name in names}
        weight = torch.cat([(block.operators[p] ** 2).sum(1) for block in blocks]).mT / candidate_rows
        rest = split(prior.kernel, sub(params, prior.prefix)).rest
        chosen.append(_greedy(rest, x, weight, limit, tolerance))
    return chosen


def _greedy(rest: KernelPart | None, x: Features, weight: Tensor, limit: int, tolerance: float) -> Selection:
    """Compute pivoted partial Cholesky factorisations of all components with common pivots."""
    if rest is None or not bool(weight.any()):
        return Selection({name: value[:0] for name, value in x.items()}, weight.new_zeros(1))
    prior = rest.kernel.diagonal(rest.params, x)
    residual = prior.clone()
    columns = prior.new_zeros(len(prior), min(limit, points(x)), points(x))
    kept, functions, missed = [], 0, [float((weight * residual).sum())]
    while len(kept) < columns.shape[1] and missed[-1] > tolerance * functions:
        # i = argmax Σ_k S_kk Var(f_k(x_i) | f(Z))
        i = int((weight * residual).sum(0).argmax())
        one = {name: value[i : i + 1] for name, value in x.items()}
        k = rest.kernel.covariance(rest.params, x, one)[..., 0]
        # ℓ = (k(X, x_i) − Lᵀ L_i) / √d_i
        so_far = columns[:, : len(kept)]
        k = k - (so_far[..., i, None].mT @ so_far)[:, 0]
        # A component that is already determined here gains nothing from a further point.
        fresh = residual[:, i] > TRUNCATION * prior[:, i]
        if not bool(fresh.any()):
            break
        column = torch.where(fresh[:, None], k * residual[:, i, None].clamp(min=1e-300).rsqrt(), 0.0)
        columns[:, len(kept)] = column
        # d ← d − ℓ²
        residual = (residual - column**2).clamp(min=0.0)
        residual[:, i] = 0.0
        kept.append(i)
        functions += int(fresh.sum())
        missed.append(float((weight * residual).sum()))
    index = torch.tensor(kept, dtype=torch.long, device=weight.device)
    return Selection({name: value[index] for name, value in x.items()}, weight.new_tensor(missed))
