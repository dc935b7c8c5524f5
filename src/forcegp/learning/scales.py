"""Hyperparameters of priors with finitely many columns: scales and noise alternate until neither changes.

1. For given torque noise, the rows of the samples are whitened, and sums over them determine the scales
   (`evidence.py`).
2. Torque noise and static friction are unknown forces ε ~ N(0, S) of single rows, with S_j = σ_j² + σ_s,j² k
   and k = e^{−(q̇/v_s)²}, and likewise for the tangential forces of contacts (`forces/unknowns.py`). The
   residual of a row is r = B ε + e with e ~ N(0, Σ), so Cov r = C = Σ + B S Bᵀ is linear in the variances
   θ = (σ², σ_s²). One step of Fisher scoring for θ ≥ 0 solves

       min ½ (θ⁺ − θ)ᵀ F (θ⁺ − θ) − gᵀ(θ⁺ − θ),  g_i = ½ Σ c_i [(Bᵀ C⁻¹ r)_i² − (Bᵀ C⁻¹ B)_ii],
       F_ij = ½ Σ c_i c_j (Bᵀ C⁻¹ B)_ij²   with   c = (1, k),

   in the directions that closed contacts leave free, where the three components of a contact force have one
   variance, over which its squares are summed. A variance that the data do not show is zero.
3. Residuals are correlated in time. If τ is their autocorrelation time, n samples contain as much information
   as κ n independent ones, κ = 1/τ. A variance with too few samples has its stated value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import scipy.optimize
import torch
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.forces.noise import EXACT, TORQUE_NOISE
from forcegp.forces.posterior import STICK_NOISE, STICK_SPEED, hidden_variance
from forcegp.forces.priors.base import NOISE
from forcegp.forces.problem import Problem, Tensors, basis_of, remainder
from forcegp.forces.quantities import affine_map
from forcegp.forces.term import NEAR_REST
from forcegp.forces.unknowns import AXES, learned_tips, share_at_rest, tip_keys, tip_operator
from forcegp.gp.sums import Sums, accumulate, without_feedback
from forcegp.learning.correlation import autocorrelation_time
from forcegp.learning.evidence import (
    SMALLEST,
    Evidence,
    Group,
    families_of,
    fixed_point,
    groups_of,
    with_scales,
    without_idle,
)

ALTERNATIONS, SETTLED, NEGLIGIBLE = 20, 0.02, 1e-3
"""Maximum number of alternations, and largest changes of σ_j at their end, relative to σ_j and to all σ."""
STEPS, ACCURACY, DIVISIONS = 50, 1e-3, 16
"""Maximum number of steps of Fisher scoring in one alternation, relative change at which they end, and
maximum number of times that a step is divided."""
RELAXATION = (0.1, 3.0)
"""Least and largest relaxation of steps. Without relaxation, a biped with eight contacts takes 3155 steps
instead of 320 (57 of 84 alternations end at `STEPS`), and `ur5_wiping` 263 instead of 202."""
LEAST_VARIANCE = EXACT**2
"""Variance of torques that is stored in place of zero [N² m², N²]."""
ROUNDING = 32.0
"""Added to the diagonal of covariances of rows, relative to it, in units of the machine epsilon ε: above the
rounding of a factorization of 18 joints, about 18 ε."""
AT_REST = (NEAR_REST, 0.05, 0.1)
"""Speeds v_s below which a joint or contact is nearly at rest, of which the likeliest is taken [rad/s, m/s]:
`NEAR_REST`, and speeds at which joints reverse within a sampling period."""
FEWEST_FOR_VARIANCE = 10.0
"""Number of samples below which a variance has its stated value. Of static friction, samples at rest count,
and of the unknown force of a contact that slides, samples in contact. Those of contacts count κ times. If κ
applied to joints too, errors on held-out blocks of the training logs of a UR10 and a UR3 would be 2 % larger,
and friction would not be learned from 40 samples."""
LEAST_SHARE = 0.2
"""Smallest share of the samples that remains after the determined directions are subtracted."""
MOTIONS = ("qdd", "joint_force", "contact_force", "multiplier")
"""Quantities that show torque noise: accelerations, joint forces computed with a force sensor, and forces of
contacts. Without the latter, ±2σ of the vertical force on a leg, learned with a sensor of this axis, holds
for 53 instead of 98 % of the training samples in one half of a log, and 95 instead of 97 % in the other."""


@dataclass(frozen=True)
class Scales:
    """Columns with their scales, and the noise of rows, after some alternations.

    Attributes:
        problem: the problem with the likelihood exponent κ.
        values: the hyperparameters.
        groups, evidence: the groups of columns, and their evidence.
        stated: logarithm of the stated scale of each group over its scale in `values` `(g,)`.
        stated_noise: stated hyperparameters of the noise.
        kept: mask `(g,)` of the groups that are learned and were not dropped.
        idle: prior and component of the families that were dropped.
        least_power: smallest κ of the residuals of learned forces.
        rounds: number of alternations.
        converged: whether they ended by themselves.
    """

    problem: Problem
    values: Tensors
    groups: list[Group]
    evidence: Evidence
    stated: Tensor
    stated_noise: Tensors
    kept: Tensor
    idle: tuple[tuple[int, int], ...] = ()
    least_power: float = 1.0
    rounds: int = 0
    converged: bool = False


@torch.no_grad()
def learned_scales(
    problem: Problem,
    start: Mapping[str, Tensor],
    learns: Callable[[str], bool],
    noisy: bool,
    begin: Mapping[str, Tensor] | None = None,
) -> Scales:
    """Return the scales of all columns and the torque noise of a problem.

    Args:
        problem: the problem; all priors have finitely many columns or inducing points.
        start: initial hyperparameters, whose scales and noise are the stated ones.
        learns: function that returns whether the scales with a given prefix are learned.
        noisy: whether torque noise is learned.
        begin: initial hyperparameters that are not at their stated values.
    """
    values = {**start, **(begin or {})}
    groups, sums = _sums(problem, values)
    kept = torch.tensor([learns(group.key.split(".")[0]) for group in groups])
    none = fixed_point(sums, groups, sums.v.new_zeros(len(groups)), torch.zeros_like(kept))
    stated = torch.zeros_like(none.log_scales)
    return _alternated(Scales(problem, values, groups, none, stated, noise_of(start), kept), noisy)


@torch.no_grad()
def pruned(scales: Scales, noisy: bool) -> Scales:
    """Return the columns that the evidence carries, with their scales and noise."""
    families = {key: f for key, f in families_of(scales.groups).items() if bool(scales.kept[f].all())}
    _, sums = _sums(scales.problem, scales.values)
    evidence, remaining = without_idle(
        sums, scales.groups, scales.stated, scales.kept, list(families.values())
    )
    idle = tuple(key for key, family in families.items() if not bool(remaining[family].any()))
    return _alternated(_moved(replace(scales, kept=remaining, idle=idle), evidence), noisy)


def noise_of(values: Mapping[str, Tensor]) -> Tensors:
    """Return the hyperparameters of the noise."""
    return {key: value for key, value in values.items() if key.startswith(NOISE + ".")}


def _sums(problem: Problem, values: Tensors) -> tuple[list[Group], Sums]:
    basis = basis_of(problem, values)
    sums = accumulate(basis, problem.rows(values).blocks)
    return groups_of(problem.priors, basis), without_feedback(sums, remainder(problem.priors, basis))


def _moved(scales: Scales, evidence: Evidence) -> Scales:
    """Return the columns with the scales of a new fixed point."""
    values = with_scales(scales.values, scales.groups, evidence.log_scales)
    return replace(scales, values=values, evidence=evidence, stated=scales.stated - evidence.log_scales)


def _alternated(scales: Scales, noisy: bool) -> Scales:
    """Alternate between scales and noise until neither changes."""
    for number in range(ALTERNATIONS):
        _, sums = _sums(scales.problem, scales.values)
        scales = _moved(scales, fixed_point(sums, scales.groups, scales.stated, scales.kept))
        scales = replace(scales, rounds=scales.rounds + 1, converged=not noisy)
        if not noisy:
            break
        before = _noise(scales.values)
        speeds = AT_REST if number == 0 else ()
        values, power = _with_noise(scales, speeds)
        # The residuals of the first round still contain the forces to be learned.
        least = min(power, scales.least_power) if number else scales.least_power
        scales = replace(
            scales, problem=replace(scales.problem, power=power), values=values, least_power=least
        )
        size = before.maximum(_noise(values))
        change = (_noise(values) - before).abs()
        if bool((change <= SETTLED * size + NEGLIGIBLE * size.amax()).all()):
            return replace(scales, converged=True)
    return scales


def _noise(values: Mapping[str, Tensor]) -> Tensor:
    return values[TORQUE_NOISE].exp()


class Residuals(NamedTuple):
    """Rows of one measurement in units of the noise, projected onto the directions that contacts leave free.

    Attributes:
        r: residuals `(n, d)`.
        B: operators `(n, d, nq + 3 c)` on the joint force and on the tangential forces of c contacts.
        slow: k `(n, nq + c)` of the joints and contacts.
        external: variance `(n, nq)` of unknown forces of given size.
    """

    r: Tensor
    B: Tensor
    slow: Tensor
    external: Tensor

    @property
    def owners(self) -> Tensor:
        """Matrix `(nq + 3 c, nq + c)` of ones in the joint or contact of each component of the forces."""
        nq, forces = self.external.shape[-1], self.slow.shape[-1]
        index = torch.arange(nq, forces).repeat_interleave(AXES)
        return torch.eye(forces).to(self.r)[torch.cat([torch.arange(nq), index])]

    @property
    def closed(self) -> Tensor:
        """Whether each contact is closed `(n, c)`."""
        return (self.B != 0.0).any(-2).to(self.r) @ self.owners[:, self.external.shape[-1] :] > 0.0

    def padded(self, d: int) -> Residuals:
        """Return the rows with zeros up to d values per sample."""
        pad, more = torch.nn.functional.pad, d - self.r.shape[-1]
        return self._replace(r=pad(self.r, (0, more)), B=pad(self.B, (0, 0, 0, more)))

    def variances(self, torque: Tensor, stick: Tensor) -> Tensor:
        """Return S `(n, nq + 3 c)` for variances σ² and σ_s² `(nq + c,)`."""
        known = torch.nn.functional.pad(self.external, (0, len(torque) - self.external.shape[-1]))
        return (torque + stick * self.slow + known) @ self.owners.mT

    def log_density(self, torque: Tensor, stick: Tensor) -> float:
        """Return Σ log N(r; 0, C) up to a constant, −∞ if C is not positive definite up to rounding."""
        S = self.variances(torque, stick)
        C = (self.B * S[:, None]) @ self.B.mT + torch.eye(self.r.shape[-1]).to(S)
        L, failed = torch.linalg.cholesky_ex(C)
        if bool(failed.any()):
            return -math.inf
        white = torch.linalg.solve_triangular(L, self.r[..., None], upper=False)
        return -float(L.diagonal(dim1=-2, dim2=-1).log().sum() + 0.5 * white.square().sum())

    def torque(self, torque: Tensor, stick: Tensor) -> Tensor:
        """Return the expected torque noise S Bᵀ C⁻¹ r `(n, nq)` for variances σ² and σ_s² `(nq + c,)`."""
        whole = self.variances(torque, stick) * self.read(torque, stick)[0]
        return whole[:, : self.external.shape[-1]]

    def noise(self, torque: Tensor, stick: Tensor) -> Tensor:
        """Return the most probable noise C⁻¹ r = r − B S Bᵀ C⁻¹ r `(n, d)` for variances σ² and σ_s²."""
        force = self.variances(torque, stick) * self.read(torque, stick)[0]
        return self.r - (self.B @ force[..., None])[..., 0]

    def read(self, torque: Tensor, stick: Tensor) -> tuple[Tensor, Tensor]:
        """Return Bᵀ C⁻¹ r `(n, nq + 3 c)` and Bᵀ C⁻¹ B for variances σ² and σ_s² `(nq + c,)`.

        Raises:
            NumericalError: C is not finite, or not positive definite.
        """
        S = self.variances(torque, stick)
        C = (self.B * S[:, None]) @ self.B.mT + torch.eye(self.r.shape[-1]).to(S)
        rounding = ROUNDING * torch.finfo(C.dtype).eps * C.diagonal(dim1=-2, dim2=-1)
        L, failed = torch.linalg.cholesky_ex(C + torch.diag_embed(rounding))
        if bool(failed.any()):
            raise NumericalError("the covariance of rows is not finite, or not positive definite")
        white = torch.linalg.solve_triangular(L, torch.cat([self.B, self.r[..., None]], -1), upper=False)
        B, r = white[..., :-1], white[..., -1:]
        return (B.mT @ r)[..., 0], B.mT @ B


def without_components(scales: Scales, priors: Sequence[int], kept: Sequence[bool], noisy: bool) -> Scales:
    """Drop components, such as joints, of some priors, and learn the noise again.

    Args:
        priors: indices of the priors.
        kept: whether to keep each component of these priors.
    """
    gone = [g.prior in priors and not kept[g.index[0]] for g in scales.groups]
    dropped = torch.tensor(gone)
    change = torch.where(dropped, math.log(SMALLEST) + scales.stated, 0.0)
    values = with_scales(scales.values, scales.groups, change)
    idle = (*scales.idle, *((p, k) for p in priors for k, keep in enumerate(kept) if not keep))
    scales = replace(
        scales, values=values, stated=scales.stated - change, kept=scales.kept & ~dropped, idle=idle
    )
    return _alternated(scales, noisy)


def residuals(problem: Problem, values: Mapping[str, Tensor], weights: Tensor, i: int) -> Residuals:
    """Return the residuals of measurement i, given the weights of the basis functions."""
    m, system = problem.training.measurements[i], problem.system
    at, process, basis = m.at(system), problem.process_at(values), basis_of(problem, values)
    rows = process.rows(system, at, process.coupled(system, at, affine_map(system, at, m.quantity)))
    r = (m.values - rows.target - basis.mean(rows, weights)) / problem.noise_at(values, i)
    return residuals_of(problem, values, i, r)


def residuals_of(problem: Problem, values: Mapping[str, Tensor], i: int, r: Tensor) -> Residuals:
    """Return the rows of measurement i with given residuals r `(n, d)`, in units of the noise."""
    m, system, std = problem.training.measurements[i], problem.system, problem.noise_at(values, i)
    at, weight = m.at(system), problem.training.weights
    z = problem.process_at(values).coupled(system, at, affine_map(system, at, m.quantity))
    std = std.expand_as(m.values)
    tips = learned_tips(system, values)
    operators = (z.B_z @ tip_operator(system, at, name) for name in tips)
    B = torch.cat([z.B_Q, *operators], dim=-1) / std[..., None]
    if m.quantity == "qdd" and system.m:
        # 1 − Ã⁺Ã with Ã = A σ
        A = at.eom.A * std[:, None]
        square = A.square().sum((1, 2), keepdim=True)
        single = A.mT / torch.where(square > 0.0, square, 1.0)
        inverse = single if system.m == 1 else torch.linalg.pinv(A, rtol=1e-9)
        N = torch.eye(A.shape[-1]).to(A) - inverse @ A
        r, B = (N @ r[..., None])[..., 0], N @ B
    r = r if weight is None else weight[i].sqrt()[:, None] * r
    slow = torch.exp(-((m.qd / values[STICK_SPEED].exp()) ** 2))
    closed = [m.active[:, system.contact_names.index(name)] for name in tips]
    rests = (share_at_rest(values, at, name).where(c, 0.0) for name, c in zip(tips, closed, strict=True))
    slow = torch.cat([slow, *(k[:, None] for k in rests)], dim=-1)
    external = hidden_variance({}, at, problem.external_std)
    return Residuals(r, B, slow, external if m.tau_std is None else external + m.tau_std**2)


def variance_keys(problem: Problem, values: Tensors) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the standard deviations in motion and of those at rest, of joints and contacts."""
    tips = [tip_keys(name) for name in learned_tips(problem.system, values)]
    return (TORQUE_NOISE, *(tip.slides for tip in tips)), (STICK_NOISE, *(tip.rests for tip in tips))


def variances(problem: Problem, values: Tensors) -> tuple[Tensor, Tensor]:
    """Return the variances σ² and σ_s² `(nq + c,)` of the forces on joints and contacts."""
    slides, rests = (
        torch.cat([(2.0 * values[key]).exp().view(-1) for key in keys])
        for keys in variance_keys(problem, values)
    )
    return slides, rests


def _with_noise(scales: Scales, speeds: Sequence[float]) -> tuple[Tensors, float]:
    """Return the hyperparameters with updated torque noise and static friction, and the exponent κ.

    Args:
        speeds: speeds v_s to try, for contacts above the stated one; the present ones if there are none.
    """
    problem, values = scales.problem, scales.values
    motions = [i for i, m in enumerate(problem.training.measurements) if m.quantity in MOTIONS]
    each = [residuals(problem, values, scales.evidence.weights, i) for i in motions]
    power = exponent(problem, motions, each, *variances(problem, values))
    widest = max(rows.r.shape[-1] for rows in each)
    parts = zip(*(rows.padded(widest) for rows in each), strict=True)
    whole = Residuals(*map(torch.cat, parts))
    nq, tips = whole.external.shape[-1], [tip_keys(name) for name in learned_tips(problem.system, values)]
    keys, theta = variance_keys(problem, values), torch.cat(variances(problem, values))
    gamma = determined_by_joint(problem, scales.groups, scales.evidence)
    share = (1.0 - gamma / (power * len(whole.r))).clamp(min=LEAST_SHARE)
    share = torch.nn.functional.pad(share, (0, len(tips)), value=1.0).repeat(2)
    driven = problem.system.robot.driven
    # The load moves between the feet of a robot with a free base, and so does the size of these forces.
    known = torch.nn.functional.pad(~driven, (0, len(tips)), value=not bool(driven.all())).repeat(2)
    variance = torch.cat(variances(problem, scales.stated_noise))
    stated = Stated(variance, min(power, scales.least_power), share, known)
    # k = e^{−(v/v_s)²} for other speeds v_s, first of the joints and then of the contacts
    rows, speed, theta = _at_likeliest_speed(
        whole, slice(0, nq), values[STICK_SPEED], speeds or None, theta, stated
    )
    changed = {STICK_SPEED: torch.full_like(values[STICK_NOISE], speed)}
    if tips and bool(driven.all()):
        now, first = (torch.stack([x[tip.speed] for tip in tips]) for x in (values, scales.stated_noise))
        least = math.exp(float(first.max()))
        above = (least, *(speed for speed in speeds if speed > least)) if speeds else None
        _, speed, theta = _at_likeliest_speed(rows, slice(nq, None), now, above, theta, stated)
        changed |= {tip.speed: torch.full_like(x, speed) for tip, x in zip(tips, now, strict=True)}
    torque, stick = theta.clamp(min=LEAST_VARIANCE).chunk(2)
    for (joints, *contacts), x in zip(keys, (0.5 * torque.log(), 0.5 * stick.log()), strict=True):
        changed |= {joints: x[:nq], **dict(zip(contacts, x[nq:].unbind(), strict=True))}
    return {**values, **changed}, power


class Stated(NamedTuple):
    """Stated variances θ, the smallest κ, the share of the samples that determines each θ, and which θ are
    known, namely those of joints without a drive."""

    theta: Tensor
    power: float
    share: Tensor
    known: Tensor


def _at_likeliest_speed(
    whole: Residuals,
    columns: slice,
    now: Tensor,
    speeds: Sequence[float] | None,
    theta: Tensor,
    stated: Stated,
) -> tuple[Residuals, float, Tensor]:
    """Return the rows, log v_s and the variances θ for the likeliest speed of some joints or contacts.

    Args:
        columns: columns of these joints or contacts in `slow`.
        now: current log v_s of each, which all share.
        speeds: speeds v_s to try, or `None` for the current one.
    """
    tried = []
    for speed in [float(now[0])] if speeds is None else map(math.log, speeds):
        slow = whole.slow.clone()
        slow[:, columns] = slow[:, columns] ** (2.0 * (now - speed)).exp()
        rows = whole._replace(slow=slow)
        free = (torch.cat(_independent(rows, stated.power)) >= FEWEST_FOR_VARIANCE) & ~stated.known
        settled = _settled(rows, torch.where(free, theta, stated.theta), stated.share, free)
        tried.append((rows.log_density(*settled.chunk(2)), rows, speed, settled))
    return max(tried, key=lambda each: each[0])[1:]


def _independent(rows: Residuals, power: float) -> tuple[Tensor, Tensor]:
    """Return the numbers of samples `(nq + c,)` in motion or contact, and of those at rest.

    Those of a contact count κ times, since its force and the torque noise of joints explain the same motion.
    """
    joints = torch.arange(rows.slow.shape[-1]).to(rows.r.device) < rows.external.shape[-1]
    rests = rows.slow.sum(0)
    moves = torch.full_like(rests, len(rows.r))
    moves[~joints] = rows.closed.sum(0).to(moves)
    return torch.where(joints, moves, power * moves), torch.where(joints, rests, power * rests)


def _settled(rows: Residuals, theta: Tensor, share: Tensor, free: Tensor) -> Tensor:
    """Return the variances θ after scoring until they no longer change.

    If the rows contain little information on a variance, a step can be far too long. A long step is divided
    by four until it does not lower the density. Short steps s are relaxed by Aitken's Δ² method (Irons and
    Tuck 1969), ω ← −ω sₖ₋₁ᵀ(sₖ − sₖ₋₁) / |sₖ − sₖ₋₁|², since they overshoot if residuals are not Gaussian.
    """
    nq, count = rows.external.shape[-1], rows.slow.shape[-1]
    joints = (torch.arange(count) < nq).repeat(2).to(theta.device)
    last, relaxation = None, 1.0
    for _ in range(STEPS if bool(free.any()) else 0):
        step = torch.where(free, _scored(rows, theta, share, free) - theta, 0.0)
        size = torch.where(joints, theta[joints].max(), theta).clamp(min=LEAST_VARIANCE)
        if bool((step.abs() > 0.5 * size).any()):
            step, last, relaxation = _shortened(rows, theta, step), None, 1.0
        else:
            if last is not None:
                change = (step - last) / size
                ratio = -float((last / size) @ change / change.square().sum().clamp(min=1e-300))
                relaxation = min(max(ratio * relaxation, RELAXATION[0]), RELAXATION[1])
            last, step = step, (theta + relaxation * step).clamp(min=0.0) - theta
        theta = theta + step
        if float((step.abs() / size).max()) < ACCURACY:
            break
    return theta


def _shortened(rows: Residuals, theta: Tensor, step: Tensor) -> Tensor:
    """Return the step, divided by four until it does not lower the density, or zero."""
    before = rows.log_density(*theta.chunk(2))
    for _ in range(DIVISIONS):
        if rows.log_density(*(theta + step).chunk(2)) >= before:
            return step
        step = 0.25 * step
    return torch.zeros_like(step)


def _scored(rows: Residuals, theta: Tensor, share: Tensor, free: Tensor) -> Tensor:
    """Return the variances θ after a step of Fisher scoring, zero for those that are not free."""
    a, D = rows.read(*theta.chunk(2))
    c, k, R = torch.cat([torch.ones_like(rows.slow), rows.slow], dim=-1), rows.slow, rows.owners
    square, expected = a.square() @ R, D.diagonal(dim1=-2, dim2=-1) @ R
    g = 0.5 * (c * (square.repeat(1, 2) / share - expected.repeat(1, 2))).sum(0)
    # Σ c_i D_ij² c_j in blocks of c = (1, k)
    D2 = R.mT @ D.square() @ R
    slowed = D2 * k[:, None]
    F_11, F_1k, F_kk = D2.sum(0), slowed.sum(0), (k[..., None] * slowed).sum(0)
    F = 0.5 * torch.cat([torch.cat([F_11, F_1k], 1), torch.cat([F_1k.mT, F_kk], 1)])
    # in units of 1/√F_ii, with a small ridge for variances that no row shows
    unit = F.diagonal().clamp(min=1e-300).rsqrt()
    F = (F * unit[:, None] * unit + 1e-9 * torch.eye(len(F)).to(F))[free][:, free]
    L = torch.linalg.cholesky(F)
    right = (F @ (theta / unit)[free] + (g * unit)[free])[:, None]
    x = torch.linalg.solve_triangular(L, right, upper=False)[:, 0]
    solution = torch.from_numpy(scipy.optimize.nnls(L.mT.cpu().numpy(), x.cpu().numpy())[0]).to(theta)
    return torch.zeros_like(theta).masked_scatter(free, solution) * unit


def exponent(
    problem: Problem, motions: list[int], each: list[Residuals], torque: Tensor, stick: Tensor
) -> float:
    """Return κ ≤ 1, one over the autocorrelation time of the residual torque, averaged over the joints.

    ε of the joints is estimated by S Bᵀ C⁻¹ r, to whose variance white noise contributes S Bᵀ C⁻² B S.
    """
    logs = []
    for i, rows in zip(motions, each, strict=True):
        m = problem.training.measurements[i]
        a, D = rows.read(torque, stick)
        S, joints = rows.variances(torque, stick), slice(0, rows.external.shape[-1])
        # Bᵀ C⁻² B = D − D S D, since C⁻¹ = 1 − C⁻¹ B S Bᵀ
        white = S * (D.diagonal(dim1=-2, dim2=-1) - (D.square() * S[:, None]).sum(-1))
        signal = (S.sqrt() * a)[:, joints]
        times = autocorrelation_time(signal, m.segment, white.mean(0)[joints])
        logs.append(times[problem.system.robot.driven].log())
    return min(1.0, math.exp(-float(torch.stack(logs).mean())))


def determined_by_joint(problem: Problem, groups: list[Group], evidence: Evidence) -> Tensor:
    """Return the number γ `(nq,)` of directions that the data determine, for each joint."""
    gamma = evidence.weights.new_zeros(problem.system.robot.nq)
    for group, g in zip(groups, evidence.determined.tolist(), strict=True):
        if problem.priors[group.prior].per_joint:
            gamma[group.index[0]] += g
        else:
            gamma += g / len(gamma)
    return gamma
