"""Scales of force priors and of torque noise, chosen by the evidence.

All columns of all priors take part in one Bayesian linear regression, y = Σ_g s_g Φ_g w_g + ε with w_g ~
N(0, I). A group g is a set of columns that share one standard deviation s_g. The scales follow from the
fixed point of the evidence (MacKay, *Bayesian interpolation*, 1992), with one pseudo-observation of the
stated scale s₀:

    s_g² ← (s_g² |ŵ_g|² + s₀²) / (γ_g + 1),   γ_g = Σ_{i ∈ g} (1 − V_ii),   V = (I + G)⁻¹,   ŵ = V v.

γ_g is the number of directions of the group that the data determine. A group that the data do not determine
keeps its stated scale, which is then its standard deviation. The Savage–Dickey ratio says what a set of
columns is worth compared with its absence,

    log p(y | w_g) / p(y | w_g = 0) = ½ ŵ_gᵀ V_gg⁻¹ ŵ_g + ½ log |V_gg|.

The sums G and v over samples depend on s only by known factors, so no sample is visited again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.forces.priors.base import ForcePrior
from forcegp.gp.basis import LatentBasis
from forcegp.gp.kernels import Columns, Constant, Kernel, Linear, Stationary
from forcegp.gp.sums import Sums

STEPS, SETTLED = 100, 1e-3
"""Maximum number of steps of the fixed point, and largest change of log s at which it ends."""

SMALLEST = 1e-6
"""Scale of a dropped group, relative to its stated scale."""
DECISIVE = 5.0
"""Log evidence against a family at which it is dropped [nats]: very strong (Kass and Raftery, *Bayes
factors*, 1995). With 0, the friction of half of the joints of a real iiwa is dropped."""
DETERMINED = 0.5
"""Share of the directions of a family that the data must determine before it can be dropped."""


@dataclass(frozen=True)
class Group:
    """Columns that share one scale.

    Attributes:
        key: name of the hyperparameter that contains the logarithm of the scale.
        index: position in this hyperparameter.
        prior: index of the prior.
        columns: positions of the basis functions `(k,)`.
    """

    key: str
    index: tuple[int, ...]
    prior: int
    columns: Tensor


@dataclass(frozen=True)
class Evidence:
    """Result of the fixed point.

    Attributes:
        log_scales: change of log s for each group `(g,)`.
        weights, variance: ŵ `(size,)` and V `(size, size)` at these scales.
        determined: γ of each group `(g,)`.
        log_evidence: ½ vᵀ V v − ½ log |I + G|, the log evidence up to a constant [nats].
    """

    log_scales: Tensor
    weights: Tensor
    variance: Tensor
    determined: Tensor
    log_evidence: float


def _entries(kernel: Kernel, components: int, width: int) -> list[list[tuple[str, tuple[int, ...]]]]:
    """Return the name and index of the scale of each basis function of each component."""
    if isinstance(kernel, Columns):
        return [[("log_slope_std", (k, d * kernel.ard)) for d in range(width)] for k in range(components)]
    if isinstance(kernel, Linear) and kernel.ard and not kernel.shared and kernel.offset is None:
        slopes = [[("log_slope_std", (k, d)) for d in range(width - 1)] for k in range(components)]
        return [[*row, ("log_bias_std", (k,))] for k, row in enumerate(slopes)]
    if isinstance(kernel, Constant):
        return [[("log_scale", (k // kernel.group,))] * width for k in range(components)]
    if isinstance(kernel, Stationary):
        return [[("log_std", (k,))] * width for k in range(components)]
    raise ModelError(
        f"the scales of a {type(kernel).__name__} kernel are not those of columns",
        expected="Linear(), Constant or a stationary kernel",
    )


def groups_of(priors: Sequence[ForcePrior], basis: LatentBasis) -> list[Group]:
    """Return the groups of columns of all priors.

    Raises:
        ModelError: a kernel has other hyperparameters than scales of columns.
    """
    groups = []
    for p, (prior, part) in enumerate(zip(priors, basis.parts, strict=True)):
        start = basis.of_process(p).start
        names = _entries(prior.kernel, *part.used.shape)
        used = part.used.flatten().tolist()
        flat = [name for name, is_used in zip(chain(*names), used, strict=True) if is_used]
        for name in dict.fromkeys(flat):
            columns = torch.tensor([start + i for i, other in enumerate(flat) if other == name])
            groups.append(Group(f"{prior.prefix}.{name[0]}", name[1], p, columns))
    return groups


def with_scales(
    values: Mapping[str, Tensor], groups: Sequence[Group], log_scales: Tensor
) -> dict[str, Tensor]:
    """Return the hyperparameters with their scales changed."""
    changed = {key: values[key].clone() for key in {group.key for group in groups}}
    for group, change in zip(groups, log_scales.tolist(), strict=True):
        changed[group.key][group.index] += change
    return {**values, **changed}


def fixed_point(
    sums: Sums, groups: Sequence[Group], stated: Tensor, free: Tensor, start: Tensor | None = None
) -> Evidence:
    """Return the scales at which the evidence is stationary.

    Args:
        sums: G and v at the present scales.
        groups: the groups of columns.
        stated: log of the stated scale of each group over its present scale `(g,)`.
        free: mask `(g,)` of the groups that are learned.
        start: initial change of log s `(g,)`; zero by default.
    """
    owner = torch.zeros(len(sums.v), dtype=torch.int64)
    for g, group in enumerate(groups):
        owner[group.columns] = g
    eye = torch.eye(len(owner)).to(sums.G)

    def add(x: Tensor) -> Tensor:
        return x.new_zeros(len(groups)).index_add(0, owner, x)

    def weights(log_s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        d = log_s.exp()[owner]
        L = torch.linalg.cholesky(eye + d[:, None] * sums.G * d)
        V = torch.cholesky_inverse(L)
        return d, L, V, V @ (d * sums.v)

    log_s, prior = torch.zeros_like(stated) if start is None else start, (2.0 * stated).exp()
    for _ in range(STEPS):
        _, _, V, w = weights(log_s)
        gamma = add(1.0 - V.diagonal()).clamp(min=0.0)
        s2 = ((2.0 * log_s).exp() * add(w.square()) + prior) / (gamma + 1.0)
        change = torch.where(free, 0.5 * s2.log() - log_s, 0.0)
        log_s = log_s + change
        if float(change.abs().max()) < SETTLED:
            break
    d, L, V, w = weights(log_s)
    log_evidence = 0.5 * float(w @ (d * sums.v)) - float(L.diagonal().log().sum())
    return Evidence(log_s, w, V, add(1.0 - V.diagonal()), log_evidence)


def worth(evidence: Evidence, columns: Tensor) -> float:
    """Return ½ ŵᵀV⁻¹ŵ + ½ log |V| for the given columns, their log evidence over their absence [nats]."""
    w, L = evidence.weights[columns], torch.linalg.cholesky(evidence.variance[columns][:, columns])
    return 0.5 * float(torch.cholesky_solve(w[:, None], L)[:, 0] @ w) + float(L.diagonal().log().sum())


def families_of(groups: Sequence[Group]) -> dict[tuple[int, int], list[int]]:
    """Return the groups of each component of each prior, such as a joint, keyed by prior and component.

    The columns of a law are nearly collinear, so that each alone seems dispensable. They are judged together.
    """
    families: dict[tuple[int, int], list[int]] = {}
    for g, group in enumerate(groups):
        families.setdefault((group.prior, group.index[0]), []).append(g)
    return families


def without_idle(
    sums: Sums, groups: Sequence[Group], stated: Tensor, free: Tensor, families: Sequence[Sequence[int]]
) -> tuple[Evidence, Tensor]:
    """Drop the families of groups that the evidence does not carry, the least worth first.

    A family that the data hardly determine is kept at its stated scale, since nothing speaks against it.

    Returns:
        The evidence, and the mask `(g,)` of the groups that remain.
    """
    kept, evidence, remaining = free.clone(), fixed_point(sums, groups, stated, free), list(families)
    while True:
        costs = []
        for family in remaining:
            columns = torch.cat([groups[g].columns for g in family])
            # A column that is zero in the log, such as that of an unknown recording, has no evidence.
            acts = int((sums.G.diagonal()[columns] > 0.0).sum())
            seen = float(evidence.determined[torch.tensor(family)].sum()) > DETERMINED * acts
            costs.append(worth(evidence, columns) if seen else 0.0)
        if not costs or min(costs) >= -DECISIVE:
            return evidence, kept
        idle = remaining.pop(costs.index(min(costs)))
        start = evidence.log_scales.clone()
        kept[idle], start[idle] = False, math.log(SMALLEST)
        evidence = fixed_point(sums, groups, stated, kept, start)
