"""Inverse dynamics of a real robot as a linear regression, validated on held-out blocks of the log.

In free motion, r = τ + Q_C + Q_G + Q_D − M₀ q̈ = C δ + Φ w + ε, with separate friction Φ w for each joint.
Each column of C is the torque due to one unknown, namely a drive inertia or an inertial parameter of a link.
Torques at rest have a larger variance, and thus less weight.

Because C contains the noise of the accelerations, least squares underestimates inertia. Each sample therefore
has a partner at a time lag beyond the correlation time of the noise. The partner's columns C′ serve as
instruments, C′ᵀ(C δ + Φ w − r) = 0. Errors are assessed by the product ε ε′, in which noise vanishes in
expectation (Söderström and Stoica, *Instrumental Variable Methods for System Identification*, 1983).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import scipy.special
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.forces.measurements import Measurement, Training
from forcegp.forces.priors import memory
from forcegp.forces.priors.base import ForceMean, ForcePrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.term import JointTerm
from forcegp.learning.held_out import stretches

LEAST, MOST = 200, 4000
"""Minimum number of samples required in free motion, and maximum number of (evenly spaced) samples used."""
NOISY = (1.0, 2.0, 4.0)
"""Apparent speeds of a joint at rest, relative to the saturation speed of the sharpest dry friction."""
MOVES = 0.1
"""Minimum fraction of samples in which a joint must move for samples at rest to have less weight."""
RIDGE = 1e-4
"""Ridge penalty on the scaled friction columns, relative to the number of samples. If a joint hardly moves,
its columns are nearly collinear. On held-out blocks of seven training logs, torque errors are 0.65 (Kinova),
0.77 (iiwa) and 0.98 to 1.01 times those with 1e-8. With 1e-3, they are 0.88 to 1.10 times as large."""
DIFFERENCE_Z = 2.0
"""Number of standard errors above which a difference is significant. If they are estimated from few blocks,
Student's t distribution applies: for eight blocks, the threshold is 2.43. With 2.0, the correct robot file
was replaced for one of 30 simulated contact logs, and force errors were 7 times as large."""
APART = 0.05
"""Time between a sample and its partner [s], unless the acceleration filter spans a longer time."""
TRUNCATION_STDS = 3.0
"""Number of standard deviations at which Gaussian weights are truncated."""
LEAST_SQUARE = 1e-300
"""Lower bound on mean squares, for joints that do not move during a block and therefore have no error."""
TOLERATED = 0.02
"""Tolerated relative increase in the held-out error."""
LATE = 0.01
"""Prior standard deviation of the delay between torque and motion [s]."""
WIDEST = 4.0 * LATE
"""Longest time between two samples whose difference counts as a derivative [s]."""
COHERENT = 0.9
"""Minimum autocorrelation between the velocities of a sample and its partner (median over the joints)."""
CENTRED = ("q", "qd", "qdd", "group", "segment", "recording")
"""Fields of samples that an average over time takes from its middle."""


@dataclass(frozen=True)
class Rows:
    """Samples in free motion. If drives are coupled, all but q are those of the drives, not of the joints.

    Attributes:
        q, qd, qdd: `(n, nq)` positions, velocities and accelerations.
        residual: torque `(n, nq)` that the robot file does not explain.
        friction: features Φ `(n, nq, f)` of the friction and offset of each joint.
        weight: `(n, nq)` inverse standard deviation of each torque, relative to that of moving joints.
        group: block index of each sample `(n,)`, numbered from 0 without gaps.
        segment: trajectory number of each sample `(n,)`.
        recording: number of the recording of each sample `(n,)`.
        partner: index of each sample's partner `(n,)`; for a sample without a partner, its own index.
        memory: additional features `(n, nq, k)` for friction with memory.
        tau: measured torque `(n, nq)`.
        rate: time derivative of the torque `(n, nq)`.
        step: time between neighbouring samples [s]; 0 if they are not in time order.
        filter_variance: variance of the weights of the filter that averaged q̈ over time [s²].
    """

    q: Tensor
    qd: Tensor
    qdd: Tensor
    residual: Tensor
    friction: Tensor
    weight: Tensor
    group: Tensor
    segment: Tensor
    recording: Tensor
    partner: Tensor
    memory: Tensor
    tau: Tensor
    rate: Tensor
    step: float = 0.0
    filter_variance: float = 0.0

    def scaled(self, scale: Tensor) -> Rows:
        """Return the samples with torques times `scale` `(nq,)`."""
        residual = self.residual + (scale - 1.0) * self.tau
        return dataclasses.replace(self, residual=residual, tau=scale * self.tau, rate=scale * self.rate)

    def with_memory(self) -> Rows:
        """Add the features of friction with memory to Φ."""
        return dataclasses.replace(self, friction=torch.cat([self.friction, self.memory], dim=-1))

    @property
    def leading(self) -> int:
        """Return the number of leading samples; all later samples are kept only as partners."""
        paired = int(self.partner[0]) > 0
        return len(self.partner) // 2 if paired else len(self.partner)


@dataclass(frozen=True)
class NormalEquations:
    """Σ ZᵀX `(..., nq, p + f, p + f)`, Σ Zᵀr, Σ Zᵀτ, Σ r² and the number of samples, for each joint.

    X = (C, Φ). Z = (C′, Φ) if instruments are used, and Z = X otherwise. For `products`, r², XᵀX and Xᵀr are
    replaced by r r′, ½ (XᵀX′ + X′ᵀX) and ½ (Xᵀr′ + X′ᵀr).
    """

    gram: Tensor
    right: Tensor
    torque: Tensor
    square: Tensor
    count: Tensor
    unknowns: int

    def total(self) -> NormalEquations:
        """Sum the equations over all blocks."""
        return self._each(lambda x: x.sum(0))

    def of(self, g: int) -> NormalEquations:
        """Return the equations of block g."""
        return self._each(lambda x: x[g])

    def without(self, g: int) -> NormalEquations:
        """Sum the equations over all blocks except g."""
        return self._each(lambda x: x.sum(0) - x[g])

    def _each(self, part: Callable[[Tensor], Tensor]) -> NormalEquations:
        sums = (self.gram, self.right, self.torque, self.square, self.count)
        gram, right, torque, square, count = map(part, sums)
        return NormalEquations(gram, right, torque, square, count, self.unknowns)

    def friction(self, delta: Tensor) -> Tensor:
        """Return the friction weights w `(nq, f)` that best fit the residual for given δ."""
        p = self.unknowns
        right = self.right[:, p:] - self.gram[:, p:, :p] @ delta
        return torch.linalg.solve(self._stiff(), right[..., None])[..., 0]

    def _stiff(self) -> Tensor:
        p = self.unknowns
        eye = torch.eye(self.gram.shape[-1] - p, dtype=self.gram.dtype, device=self.gram.device)
        return self.gram[:, p:, p:] + RIDGE * self.count[:, None, None] * eye

    def quadratic(self, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return H and h in H δ = h for optimal friction, and the change of h per relative error of each
        torque sensor's gain `(p, nq)`. Without instruments, δ minimises Σ |ε_j|²/s_j².
        """
        H, h, per_gain = self.by_joint(noise)
        return H.sum(0), h.sum(0), per_gain.mT

    def by_joint(self, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the summands of `quadratic` of each joint."""
        # Friction is eliminated by a Schur complement: H_j = G_δδ − G_δf (G_ff + D)⁻¹ G_fδ, H = Σ_j H_j/s_j²
        p = self.unknowns
        columns = torch.cat([self.gram[..., :p], torch.stack([self.right, self.torque], dim=-1)], dim=-1)
        friction = torch.linalg.solve(self._stiff(), columns[:, p:])
        reduced = (columns[:, :p] - self.gram[:, :p, p:] @ friction) * (noise**-2)[:, None, None]
        return reduced[..., :p], reduced[..., p], reduced[..., p + 1]

    def error(self, delta: Tensor, friction: Tensor) -> Tensor:
        """Return the mean `(nq,)` of ε², or of ε ε′ for `products`."""
        x = torch.cat([delta.expand(len(friction), -1), friction], dim=-1)
        fitted = 2.0 * (x * self.right).sum(-1) - torch.einsum("jp,jpq,jq->j", x, self.gram, x)
        return (self.square - fitted) / self.count


Estimate = Callable[[NormalEquations], Tensor]
"""Function that estimates δ from normal equations."""


def free_rows(
    system: ConstrainedSystem,
    laws: Sequence[JointTerm],
    mean: ForceMean,
    training: Training,
    most: int = MOST,
) -> Rows:
    """Return samples in free motion, and their partners, from the first measurement with enough of them."""
    motions = (m for m in training.measurements if m.quantity == "qdd")
    free = ((m, (~m.active.any(-1)).nonzero()[:, 0]) for m in motions)
    m = next(m[rows] for m, rows in free if len(rows) >= LEAST)
    later, rate = partners(m, training.filter_span), system.robot.drive_torque(torque_rate(m))
    memory = bristles(dataclasses.replace(m, qd=system.robot.drive_motion(m.qd)))
    first = (later >= 0).nonzero()[:, 0]
    paired = len(first) >= LEAST
    if not paired:
        first = torch.arange(len(m.t), device=m.t.device)
    first = first[torch.linspace(0, len(first) - 1, min(most, len(first))).round().long().to(m.t.device)]
    _, group = stretches(m.segment[first]).unique(return_inverse=True)
    i = torch.arange(len(first), device=m.t.device)
    if not paired:
        return _rows(system, laws, mean, m[first], memory[first], rate[first], group, i)
    both, n = torch.cat([first, later[first]]), len(first)
    partner = torch.cat([i + n, i])
    rows = _rows(system, laws, mean, m[both], memory[both], rate[both], group.repeat(2), partner)
    step = max(0.0, float(m.t[first].diff().median()))
    return dataclasses.replace(rows, step=step, filter_variance=training.filter_variance)


def bristles(m: Measurement | Dataset) -> Tensor:
    """Return the state of bristles `(n, nq, k)`.

    Within a distance δ of a reversal, this friction acts like a spring, with a torque that is roughly
    proportional to −q̈. Without these columns, friction would be mistaken for negative inertia.
    """
    return memory.bristles(m.t, m.qd, m.segment)[..., : len(memory.DISTANCES)]


def _in_time(m: Measurement | Dataset) -> Tensor:
    return memory.in_time(m.t, m.segment)


def torque_rate(m: Measurement) -> Tensor:
    """Return the time derivative `(n, nq)` of the torque, from differences over `LATE` on either side.

    A small delay between torque and motion changes the torque in proportion to this derivative. It is zero
    where neighbours in time are missing.
    """
    order = _in_time(m)
    t, tau, segment = m.t[order], m.tau[order], m.segment[order]
    step = float(t.diff()[segment[1:] == segment[:-1]].median()) if len(t) > 1 else 0.0
    rate = torch.zeros_like(tau)
    if step > 0.0:
        i, reach = torch.arange(len(t), device=t.device), max(1, round(min(LATE / step, len(t))))
        _, inverse, counts = segment.unique_consecutive(return_inverse=True, return_counts=True)
        stop = counts.cumsum(0)
        before = torch.maximum(i - reach, (stop - counts)[inverse])
        after = torch.minimum(i + reach, stop[inverse] - 1)
        span = (t[after] - t[before])[:, None]
        slope = (tau[after] - tau[before]) / span.clamp(min=1e-300)
        rate[order] = torch.where((span > 0.0) & (span <= WIDEST), slope, 0.0)
    return rate


def without_delay(training: Training, priors: Sequence[ForcePrior]) -> Training:
    """Return the samples with torques that act on the motion when they are logged, τ(t − s) ≈ τ − s dτ/dt.

    The priors contain the identified delay s.
    """
    delay = sum(prior.delay for prior in priors)
    if not delay:
        return training
    measurements = (dataclasses.replace(m, tau=m.tau - delay * torque_rate(m)) for m in training.measurements)
    return dataclasses.replace(training, measurements=tuple(measurements))


def partners(m: Measurement, filter_span: float = 0.0) -> Tensor:
    """Return the index `(n,)` of the sample `APART` later in the same trajectory, or −1 if there is none.

    The lag is reduced if velocities would change too much, but not below the span of the log's filter [s],
    over which noise is correlated.
    """
    later = torch.full((len(m.t),), -1, device=m.t.device)
    order = _in_time(m)
    t, qd, segment = m.t[order], m.qd[order], m.segment[order]
    steps = t.diff()[segment[1:] == segment[:-1]]
    if not len(steps) or float(steps.median()) <= 0.0:
        return later
    step, scale = float(steps.median()), qd.square().mean(0).clamp(min=1e-300)
    least = max(1, math.ceil(filter_span / step - 1e-6))
    for lag in range(least, max(least, round(APART / step)) + 1):
        near = (segment[lag:] == segment[:-lag]) & ((t[lag:] - t[:-lag] - lag * step).abs() < 0.5 * step)
        coherence = (qd[lag:] * qd[:-lag])[near].mean(0) / scale
        spanned = lag == least > 1
        if int(near.sum()) < LEAST or (not spanned and float(coherence.median()) < COHERENT):
            break
        later.fill_(-1)
        later[order[:-lag][near]] = order[lag:][near]
    return later


def _rows(
    system: ConstrainedSystem,
    laws: Sequence[JointTerm],
    mean: ForceMean,
    m: Measurement,
    memory: Tensor,
    rate: Tensor,
    group: Tensor,
    partner: Tensor,
) -> Rows:
    at, robot = m.at(system), system.robot
    columns = [column for law in laws for column in law.features(system, at).values()]
    Phi = torch.cat([*columns, torch.ones_like(at.q)[..., None]], dim=-1)
    Phi, memory = (x / x.square().mean(0).sqrt().clamp(min=1e-12) for x in (Phi, memory))
    Phi, memory = (robot.driven[:, None] * x for x in (Phi, memory))
    residual = robot.drive_torque(mean(system, at) - (at.eom.M @ m.values[..., None])[..., 0])
    qd, qdd, tau = robot.drive_motion(m.qd), robot.drive_motion(m.values), robot.drive_torque(m.tau)
    slowest = min(min(law.speeds) for law in laws if isinstance(law, JointFrictionPrior))
    weight = rest_weight(qd.abs(), slowest, Phi, residual)
    along = group, m.segment, m.recording, partner
    return Rows(m.q, qd, qdd, residual, Phi, weight, *along, memory, tau, rate)


def rest_weight(speed: Tensor, slowest: float, Phi: Tensor, residual: Tensor) -> Tensor:
    """Return the standard deviation of torques in motion over that of each torque, `(n, nq)`, 1 in motion.

    A joint at rest holds any torque below its static friction, which adds to the variance. Because of noise,
    its speed is not zero. The threshold of speed is the one below which torques scatter most. On nine
    simulated logs, ±2σ holds for 95 % of 60 joint inertias. If torques at rest have no weight where they
    scatter four times as much and the full weight elsewhere, it holds for 92 %.

    Args:
        speed: |q̇| `(n, nq)`.
        slowest: saturation speed of the sharpest dry friction [rad/s, m/s].
        Phi: features of friction `(n, nq, f)`.
        residual: `(n, nq)` torque that the robot file does not explain.
    """
    weight, most = torch.ones_like(speed), torch.ones_like(speed[0])
    # From moving joints alone, friction at low speed would be extrapolated, as its columns saturate.
    w = ridged(Phi.transpose(0, 1), residual.mT)
    square = (residual - (Phi * w).sum(-1)).square()
    for bound in (slowest * factor for factor in NOISY):
        moving = speed >= bound
        parts = (~moving).double(), moving.double()
        at_rest, in_motion = ((part * square).sum(0) / part.sum(0).clamp(min=1) for part in parts)
        ratio = at_rest / in_motion.clamp(min=LEAST_SQUARE)
        larger = (ratio > most) & (moving.double().mean(0) >= MOVES)
        weight = torch.where(larger, torch.where(moving, 1.0, ratio.rsqrt()), weight)
        most = torch.where(larger, ratio, most)
    return weight


def ridged(X: Tensor, r: Tensor) -> Tensor:
    """Return the weights `(..., f)` of scaled columns X `(..., n, f)` in r `(..., n)`, with ridge penalty.

    Columns that are nearly collinear, or zero up to rounding, would make the result depend on rounding.
    """
    gram = X.mT @ X + RIDGE * X.shape[-2] * torch.eye(X.shape[-1]).to(X)
    return torch.linalg.solve(gram, X.mT @ r[..., None])[..., 0]


def averaged(rows: Rows, columns: Tensor, inertial: Tensor, width: float) -> tuple[Rows, Tensor]:
    """Average the equations over time with Gaussian weights; sums of valid equations remain valid.

    Differentiated positions have high-frequency noise, whereas motion has low frequencies. Since a filter has
    already averaged the accelerations, the variance of its weights is added when averaging the other terms.

    Args:
        columns: C `(n, nq, p)`.
        inertial: term M₀ q̈ `(n, nq)` of the residual.
        width: standard deviation of the weights [s].

    Returns:
        The averaged samples and their columns. An average has the least weight of its window, and none if the
        window does not lie within one block.
    """
    stds = [x / rows.step for x in (width, math.hypot(width, math.sqrt(rows.filter_variance)))]
    n = rows.leading
    reach, stride = min(math.ceil(TRUNCATION_STDS * stds[1]), (n - 1) // 2), max(1, int(0.5 * stds[0]))
    offset = torch.arange(-reach, reach + 1).to(columns)
    narrow, wide = (torch.softmax(-0.5 * (offset / max(std, 1e-9)) ** 2, 0) for std in stds)
    starts = range(0, len(rows.q), n)
    count = len(range(reach, n - reach, stride))

    def over(x: Tensor, weights: Tensor) -> Tensor:
        total = x.new_zeros(len(starts), count, *x.shape[1:])
        for k, w in enumerate(weights.tolist()):
            for part, first in zip(total, starts, strict=True):
                part += w * x[first + k : first + n - 2 * reach + k : stride]
        return total.flatten(0, 1)

    def shifted(x: Tensor, k: int) -> Tensor:
        return torch.cat([x[first + k : first + n - 2 * reach + k : stride] for first in starts])

    whole = torch.stack([shifted(x, 0) == shifted(x, 2 * reach) for x in (rows.group, rows.segment)]).all(0)
    least = torch.stack([shifted(rows.weight, k) for k in range(2 * reach + 1)]).amin(0)
    centre = {name: shifted(getattr(rows, name), reach) for name in CENTRED}
    i = torch.arange(count, device=columns.device)
    result = dataclasses.replace(
        rows,
        **centre,
        residual=over(rows.residual + inertial, wide) - over(inertial, narrow),
        friction=over(rows.friction, wide),
        memory=over(rows.memory, wide),
        tau=over(rows.tau, wide),
        rate=over(rows.rate, wide),
        weight=least * whole[:, None],
        partner=torch.cat([i + count, i]) if len(starts) == 2 else i,
        step=stride * rows.step,
        filter_variance=0.0,
    )
    return result, over(columns, narrow)


def sums(rows: Rows, columns: Tensor) -> NormalEquations:
    """Return the `NormalEquations` of each block for the columns C `(n, nq, p)`."""
    X, r, w = _equations(rows, columns)
    return _by_stretch(rows, X, X, r, r, w)


def instrumental(rows: Rows, columns: Tensor) -> NormalEquations:
    """Return the equations with partners as instruments. Velocities and friction are considered exact."""
    X, r, w = _equations(rows, columns, paired=True)
    p = columns.shape[-1]
    return _by_stretch(rows, torch.cat([X[rows.partner][..., :p], X[..., p:]], dim=-1), X, r, r, w)


def products(rows: Rows, columns: Tensor) -> NormalEquations:
    """Return the `NormalEquations` for products of samples with their partners."""
    X, r, w = _equations(rows, columns, paired=True)
    return _by_stretch(rows, X[rows.partner], X, r[rows.partner], r, w)


def _equations(rows: Rows, columns: Tensor, paired: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Return X and r times the weight of each row, or of it and its partner if `paired`, and the weight."""
    weight = (rows.weight * rows.weight[rows.partner]).sqrt() if paired else rows.weight
    X = torch.cat([columns, rows.friction], dim=-1)
    return X * weight[..., None], rows.residual * weight, weight


def _by_stretch(rows: Rows, Z: Tensor, X: Tensor, s: Tensor, r: Tensor, w: Tensor) -> NormalEquations:
    """Return Σ ZᵀX, Σ Zᵀr, Σ Zᵀτ, Σ s r and Σ w² for rows and torques with weight w."""
    groups = []
    for g in range(int(rows.group.max()) + 1):
        inside = rows.group == g
        z, x = Z[inside].transpose(0, 1), X[inside].transpose(0, 1)
        count = w[inside].square().sum(0).clamp(min=1.0)
        right, torque = ((z.mT @ part[inside].mT[..., None])[..., 0] for part in (r, w * rows.tau))
        groups.append((z.mT @ x, right, torque, (s[inside] * r[inside]).sum(0), count))
    gram, right, torque, square, count = (torch.stack(parts) for parts in zip(*groups, strict=True))
    return NormalEquations(gram, right, torque, square, count, X.shape[-1] - rows.friction.shape[-1])


def held_out(
    by_stretch: NormalEquations,
    estimate: Estimate,
    judged: NormalEquations | None = None,
    source: NormalEquations | None = None,
) -> Tensor:
    """Return the mean squared torque errors `(groups, nq)` on blocks that are not used to estimate δ and w.

    Args:
        by_stretch: equations used to estimate friction.
        estimate: function that estimates δ from all blocks except one.
        judged: equations used to compute errors, such as `products`; defaults to `by_stretch`.
        source: equations used to estimate δ, such as averaged equations; defaults to `by_stretch`.
    """
    errors = []
    for g in range(len(by_stretch.gram)):
        rest = by_stretch.without(g)
        delta = estimate(rest if source is None else source.without(g))
        errors.append((judged or by_stretch).of(g).error(delta, rest.friction(delta)))
    return torch.stack(errors)


def acceleration_errors(
    rows: Rows, by_stretch: NormalEquations, columns: Tensor, delta: Tensor, M: Tensor
) -> Tensor:
    """Return the mean squared acceleration errors `(groups, nq)` for given δ, with held-out friction."""
    residual, errors = rows.residual - columns @ delta, []
    for g in range(len(by_stretch.gram)):
        inside = rows.group == g
        force = residual[inside] - (rows.friction[inside] * by_stretch.without(g).friction(delta)).sum(-1)
        missed = torch.linalg.solve(M[inside], (rows.weight[inside] * force)[..., None])[..., 0]
        errors.append(missed.square().mean(0))
    return torch.stack(errors)


def log_ratio(after: Tensor, before: Tensor) -> Tensor:
    """Return the log ratio of root mean squares, which is zero for a joint at rest during a block."""
    return 0.5 * (after.clamp(min=LEAST_SQUARE) / before.clamp(min=LEAST_SQUARE)).log()


def is_harmless(after: Tensor, before: Tensor) -> bool:
    """Return whether errors `(groups, nq)` rise by no more than the tolerance in the geometric mean.

    With Gaussian errors of unknown variance σ_j², the log density of n samples is −n Σ_j log σ_j at its
    maximum. The mean of log σ_j over the joints therefore compares densities, in any units of the joints.
    """
    return float(log_ratio(after, before).mean()) <= TOLERATED


def is_less(difference: Tensor) -> bool:
    """Return whether the mean of differences `(groups,)` is significantly below zero (Student's t test)."""
    n = len(difference)
    least = float(scipy.special.stdtrit(n - 1, scipy.special.ndtr(DIFFERENCE_Z)))
    return float(difference.mean()) < -least * float(difference.std()) / math.sqrt(n)
