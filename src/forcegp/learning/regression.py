"""Learning of columns: scales and noise from the evidence, Coulomb friction, ripple, and a residual force.

Scales of columns (`evidence.py`) and variances of rows (`scales.py`) follow from the evidence. The Coulomb
friction of contacts, which is not linear in its parameters, is searched given these scales.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import scipy.special
import torch
from torch import Tensor

from forcegp.forces.measurements import Training, scaled
from forcegp.forces.noise import TORQUE_NOISE, white_noise_std
from forcegp.forces.posterior import MEMORY
from forcegp.forces.priors.base import COULOMB, NOISE, ForcePrior
from forcegp.forces.priors.memory import BristlePrior
from forcegp.forces.priors.ripple import RipplePrior, ripple_of
from forcegp.forces.problem import Problem, Tensors, basis_of, noise_key, with_inducing, without_inducing
from forcegp.forces.term import EXPECTED, ONE, JointTerm
from forcegp.gp.kernels import Columns, Constant, Kernel, Linear, SquaredExponential
from forcegp.gp.optimise import FitProgress, LearningOptions
from forcegp.learning.evidence import families_of, worth
from forcegp.learning.held_out import held_out_squares
from forcegp.learning.noise_learning import weighted
from forcegp.learning.scales import (
    MOTIONS,
    Scales,
    learned_scales,
    noise_of,
    pruned,
    residuals,
    variances,
    without_components,
)
from forcegp.learning.search import Search, initial

SAMPLES = 4000
"""Maximum number of evenly spaced samples from which scales and noise are learned. Ten parameters of a joint
need hundreds of independent samples, and residuals are correlated over about 20."""
FIRST_POWER = 0.1
"""Exponent of the likelihood before the correlation of the residuals is known."""
FRICTION_SAMPLES = 400
"""Maximum number of samples for the search for Coulomb friction, which whitens all rows at each step."""
CHANCE = 0.02
"""Probability of keeping a residual force of any joint that does not exist, that of two standard errors."""
SUPPORT = 64
"""Maximum number of support points of a residual force."""
PASSES = 3
"""Maximum number of searches for Coulomb friction, each followed by new scales."""
SETTLED = 0.01
"""Change of the logarithm of a friction coefficient at which the passes end."""
QUICK = LearningOptions(tolerance=1e-6, max_evaluations=60)
LEAST_ACCELERATION_NOISE = 1e-3
"""Smallest noise of accelerations, relative to their standard deviation. Filters remove white noise, and the
rest counts as torque noise."""


def is_column(kernel: Kernel) -> bool:
    """Return whether the only hyperparameters of a kernel are scales of columns."""
    plain = type(kernel) is Linear and kernel.ard and not kernel.shared and kernel.offset is None
    return (
        plain
        or isinstance(kernel, Columns | Constant)
        or (type(kernel) is SquaredExponential and kernel.shared)
    )


def are_columns(priors: tuple[ForcePrior, ...]) -> bool:
    """Return whether all priors consist of columns."""
    return all(is_column(prior.kernel) for prior in priors)


@dataclass(frozen=True)
class Regression:
    """Learned columns, ready for conditioning on all samples.

    Attributes:
        problem: the problem with the likelihood exponent κ of the samples learned from.
        values: the hyperparameters.
        samples: number of samples learned from.
        rounds: number of alternations between scales and noise.
        converged: whether they ended by themselves.
        objective: negative log evidence of the rows, up to a constant.
        worth: log evidence of each prior for each joint over its absence [nats], keyed by prior and joint.
    """

    problem: Problem
    values: Tensors
    samples: int
    rounds: int
    converged: bool
    objective: float
    worth: Mapping[str, float]


def with_expectations(problem: Problem) -> Problem:
    """Return the problem whose bristles know their mean at a velocity, from its training data."""
    changed = {}
    for prior in problem.priors:
        for m in problem.training.measurements:
            if isinstance(prior, BristlePrior) and not prior.expected and m.history is not None:
                turning = problem.system.robot.drive_motion(m.qd)
                changed[prior.name] = prior.expecting(turning, m.history)
                break
    if not changed:
        return problem
    priors = tuple(changed.get(prior.name, prior) for prior in problem.priors)
    kept = {p.name: s for p, s in zip(priors, problem.training.scales, strict=True) if p.name not in changed}
    training = scaled(problem.training, problem.system, priors, kept)
    return dataclasses.replace(problem, priors=priors, training=training)


@torch.no_grad()
def regression(
    problem: Problem,
    start: Tensors,
    learns: Callable[[str], bool],
    prunes: bool = False,
    degrees_of_freedom: float | None = None,
    progress: FitProgress | None = None,
) -> Regression:
    """Learn the scales of columns, torque noise and Coulomb friction of a problem.

    Args:
        problem: the problem with all samples in memory.
        start: initial hyperparameters, with those that are not learned at their values.
        learns: function that returns whether the part with a given name is learned.
        prunes: whether to drop columns that the evidence does not carry.
        degrees_of_freedom: degrees of freedom of Student t noise, or `None` for Gaussian noise.
        progress: function called after each pass with its number, the total number, and NaN.
    """
    part = dataclasses.replace(problem, training=problem.training.evenly(SAMPLES), power=FIRST_POWER)
    noisy = learns(NOISE) and TORQUE_NOISE in start
    later = [prior.name for prior in part.priors if prior.remainder]
    remainder = {key: value for key, value in start.items() if key.split(".")[0] in later}
    rest = {key: value for key, value in start.items() if key not in remainder}
    named = without_inducing(part.without_priors(later))

    def of_laws(named: Problem, start: Tensors, learns: Callable[[str], bool]) -> Scales:
        return _alternating(named, start, learns, noisy, prunes, degrees_of_freedom, progress)

    scales = of_laws(named, rest, learns)
    if prunes and noisy and (ripple := ripple_in(scales)) is not None:
        others, name = [prior.name for prior in named.priors], ripple.name
        named = named.with_priors([ripple])
        begin = {**initial(named.without_priors(others), False), **rest}
        rippled = of_laws(named, begin, lambda each: each == name or learns(each))
        p = [prior.name for prior in rippled.problem.priors].index(name)
        dropped = sum(prior == p for prior, _ in rippled.idle)
        scales = rippled if dropped < named.system.robot.nq else scales
    if later:
        scales = with_remainder(part, scales, remainder, learns, noisy, prunes)
    values = {**scales.values, **memory_noise(scales), **expected_forces(scales)}
    objective = -scales.evidence.log_evidence
    return Regression(
        scales.problem.without_errors().with_priors(part.errors, part),
        values,
        scales.problem.training.samples,
        scales.rounds,
        scales.converged,
        objective,
        worth_of(scales),
    )


def _alternating(
    part: Problem,
    start: Tensors,
    learns: Callable[[str], bool],
    noisy: bool,
    prunes: bool,
    degrees_of_freedom: float | None,
    progress: FitProgress | None,
) -> Scales:
    """Return scales and noise of laws after alternating with a search for Coulomb friction, without columns
    that the evidence does not carry."""
    friction = [key for key in start if key.startswith(COULOMB + ".") and learns(COULOMB)]
    passes = PASSES if friction or degrees_of_freedom is not None else 1
    start, begin, number = dict(start), None, 0
    while True:
        number += 1
        scales = learned_scales(part, start, learns, noisy, begin)
        part, values = scales.problem, scales.values
        if progress is not None:
            progress(number, passes, math.nan)
        if number == passes:
            break
        if degrees_of_freedom is not None:
            part = weighted(part, values, degrees_of_freedom)
        searched = _coulomb(part, values, friction) if friction else {}
        settled = all(float((searched[key] - values[key]).abs().max()) < SETTLED for key in friction)
        if settled and degrees_of_freedom is None:
            break
        # The scales start from the stated ones again.
        start, begin = {**start, **searched}, noise_of(values)
    return pruned(scales, noisy) if prunes else scales


def ripple_in(scales: Scales) -> RipplePrior | None:
    """Return the ripple in the residual torques, or `None` if there is none or it is known."""
    problem, parts = scales.problem, []
    if any(isinstance(prior, RipplePrior) for prior in problem.priors):
        return None
    for i, m in enumerate(problem.training.measurements):
        if m.quantity in MOTIONS:
            rows = residuals(problem, scales.values, scales.evidence.weights, i)
            torque, robot = rows.torque(*variances(problem, scales.values)), problem.system.robot
            parts.append((robot.drive_motion(m.q), robot.drive_torque(torque)))
    return ripple_of(*map(torch.cat, zip(*parts, strict=True))) if parts else None


def with_remainder(
    whole: Problem,
    laws: Scales,
    start: Tensors,
    learns: Callable[[str], bool],
    noisy: bool,
    prunes: bool,
) -> Scales:
    """Return the columns with those of a residual force, learned from what all laws leave.

    Errors of laws are correlated along a motion, so that a function of the state describes them on this
    motion only. If `prunes`, the force of a joint is kept if it reduces the errors on held-out blocks.

    Args:
        whole: the problem with the residual force.
        laws: the result without it.
        start: initial hyperparameters of the residual force.
    """
    later = [prior for prior in whole.priors if prior.remainder]
    names = {prior.name for prior in later}
    base = laws.problem.without_errors()
    problem = base.with_priors(later, whole)
    values = {**laws.values, **start}
    problem = with_inducing(problem, values, SUPPORT)
    stated, learns_later = {**values, **laws.stated_noise}, lambda name: name in names and learns(name)
    scales = learned_scales(problem, stated, learns_later, noisy, noise_of(values))
    scales = dataclasses.replace(scales, idle=laws.idle)
    if not prunes or not all(map(learns, names)):
        return scales
    changes = held_out_squares(scales.problem, scales.values) - held_out_squares(base, laws.values)
    kept = _are_smaller(changes)
    if not any(kept):
        return laws
    return without_components(
        scales, [p for p, prior in enumerate(problem.priors) if prior.remainder], kept, noisy
    )


def _are_smaller(changes: Tensor) -> list[bool]:
    """Return for each joint whether changes `(blocks, nq)` are below zero, by a t-test over the blocks."""
    blocks, joints = changes.shape
    if blocks < 2:
        return [False] * joints
    most = scipy.special.stdtrit(blocks - 1, CHANCE / joints)
    return (changes.mean(0) < most * changes.std(0) / math.sqrt(blocks)).tolist()


def _coulomb(problem: Problem, values: Mapping[str, Tensor], keys: list[str]) -> Tensors:
    """Return the Coulomb friction of contacts that is most probable for given scales and noise."""
    few = problem.showing_coulomb(FRICTION_SAMPLES)
    few = dataclasses.replace(
        few, power=min(1.0, problem.power * problem.training.samples / few.training.samples)
    )
    begin = {key: values[key] for key in keys}
    held = {key: value for key, value in values.items() if key not in begin}
    with torch.enable_grad():
        return dict(Search(begin, held, QUICK).solve(few, begin=begin).tensors)


def memory_noise(scales: Scales) -> Tensors:
    """Return the standard deviation `(nq,)` of the force of bristles at a state without past, if any.

    With columns φ of a joint and weights w ~ N(ŵ, V), the variance is Σ (ŵ ŵᵀ + V) E[φ φᵀ] over the log.
    """
    problem, basis, variance = scales.problem, basis_of(scales.problem, scales.values), {}
    process = problem.process_at(scales.values)
    for p, prior in enumerate(problem.priors):
        past = [m for m in problem.training.measurements if m.history is not None]
        if isinstance(prior, JointTerm) and prior.remembers and past:
            x = [process.features(p, problem.system, m.at(problem.system)) for m in past]
            phi = torch.cat([basis.parts[p].values(each)[0] for each in x], dim=1)
            square = phi.mT @ phi / phi.shape[1]
            columns = basis.of_process(p)
            w = scales.evidence.weights[columns].view(len(phi), -1)
            V = scales.evidence.variance[columns, columns].view(*w.shape, *w.shape)
            V = torch.stack([V[j, :, j] for j in range(len(w))])
            each = ((w[:, :, None] * w[:, None] + V) * square).sum((1, 2))
            each = each * problem.system.robot.driven if prior.needs_drive else each
            variance[MEMORY] = variance.get(MEMORY, 0.0) + each
    return {key: 0.5 * value.clamp(min=1e-24).log() for key, value in variance.items()}


def expected_forces(scales: Scales) -> Tensors:
    """Return the weights of an `ExpectedForce` in units of the columns, if contact friction depends on it.

    The basis functions are the columns times a constant for each joint, V = φ g.
    """
    problem, basis, expected = scales.problem, basis_of(scales.problem, scales.values), {}
    if not problem.has_coulomb:
        return expected
    process, system = problem.process_at(scales.values), problem.system
    at = problem.training.measurements[0].at(system)
    for p, prior in enumerate(problem.priors):
        if not isinstance(prior, JointTerm) or not isinstance(prior.kernel, Linear) or prior.is_error:
            continue
        w = scales.evidence.weights[basis.of_process(p)].view(system.robot.nq, -1)
        V = basis.parts[p].values(process.features(p, system, at))[0]
        # A constant, if the kernel has one, is the last basis function.
        columns = {**prior.features(system, at), ONE: torch.ones_like(at.q)[..., None]}
        for c, (name, phi) in zip(range(V.shape[-1]), columns.items(), strict=False):
            x = phi[..., 0].mT
            g = (V[..., c] * x).sum(1) / x.square().sum(1).clamp(min=1e-300)
            expected[f"{EXPECTED}.{prior.name}.{name}"] = g * w[:, c]
    return expected


def worth_of(scales: Scales) -> dict[str, float]:
    """Return the log evidence of each prior and joint over its absence [nats]; 0 for those dropped.

    Errors of what the robot includes are not judged.
    """
    result, joints, priors = {}, scales.problem.system.robot.joint_names, scales.problem.priors
    for (p, k), family in families_of(scales.groups).items():
        if priors[p].is_error:
            continue
        several = scales.values[scales.groups[family[0]].key].shape[0] > 1
        part = f" of {joints[k]}" if priors[p].per_joint else f" {k + 1}" if several else ""
        name = f"{priors[p].name}{part}"
        columns = torch.cat([scales.groups[g].columns for g in family])
        result[name] = 0.0 if (p, k) in scales.idle else worth(scales.evidence, columns)
    return result


def acceleration_noise(training: Training) -> tuple[Tensor, ...]:
    """Return the white noise `(d,)` of each measurement whose noise is not stated."""
    stds = []
    for m, std in zip(training.measurements, training.noise_std, strict=True):
        if m.quantity != "qdd":
            stds.append(std)
            continue
        least = LEAST_ACCELERATION_NOISE * m.values.std(0).clamp(min=1e-9)
        whole = m.segment[4:] == m.segment[:-4]
        if training.period and bool(whole.any()):
            least = least.maximum(white_noise_std(m.values, whole))
        stds.append(least)
    return tuple(stds)


def with_acceleration_noise(problem: Problem) -> tuple[Problem, Tensors]:
    """Return the problem with the white noise of its accelerations, and this noise as hyperparameters."""
    noise = acceleration_noise(problem.training)
    training = dataclasses.replace(problem.training, noise_std=noise)
    return dataclasses.replace(problem, training=training), {
        noise_key(i): s.log() for i, s in enumerate(noise)
    }
