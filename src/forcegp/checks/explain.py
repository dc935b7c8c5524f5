"""Which fault explains the torque best: greedy choice by cross-validation, one-standard-error rule.

Round by round the simplest hypothesis within one standard error of the best is taken (Breiman, Friedman,
Olshen, Stone, *Classification and Regression Trees*, 1984, sec. 3.4.3), as long as it lowers the held-out
error by more than chance and more than matters. The log is then corrected, and the next round looks for a
second fault, so that one fault does not show as several.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from forcegp.checks.finding import Finding
from forcegp.checks.fit import TorqueFit, TorqueProblem, cross_validate, gain_of, pooled_gain_of, score_of
from forcegp.checks.hypotheses import (
    LAGS,
    ROBOT,
    Hypothesis,
    continuous,
    corrected,
    current_hypothesis,
    delays,
    discrete,
    encoder_hypothesis,
    finding_of,
    gain_hypothesis,
    plausible,
    problem_of,
    robot_hypotheses,
    with_log,
)
from forcegp.checks.log import Array, Log
from forcegp.checks.placement import leaves_surface
from forcegp.constraints import ConstrainedSystem

ROWS = 1600
"""Rows that hypotheses are tested on."""
SCREENING = 4
"""Share of these rows, as its inverse, on which hypotheses must do better first."""
ROUNDS = 5
"""Faults that are looked for at most."""
SIGNIFICANT = 4.0
"""Standard errors by which the held-out score must drop; there are about a hundred hypotheses."""
SHARE = 0.03
"""Share of the best drop that a simpler hypothesis may leave to a second round."""
SAME = 1e-3
"""Relative difference of errors that are equal."""
DETERMINED = 3.0
"""A gain counts as known if it exceeds this many standard errors."""
MATERIAL = 0.15
"""Drop of Σ_j log error that matters: 14 % less error in one joint."""
MATERIAL_EACH = 0.05
"""Drop of log error per joint that matters where all joints are concerned."""


@dataclass(frozen=True)
class Explanation:
    """What the torque says about log and robot file.

    Attributes:
        findings: faults found, the most telling first.
        log: the log without them.
        repairs: what takes the faults out of a log, in order.
        problem: the torques that remain, over `rows`.
        robot: names of the accepted hypotheses about the robot, which stay in the model.
        columns, prior: their columns, and how large their parameters may be.
        fit: the model that remains.
        rows: rows that were looked at.
    """

    findings: list[Finding]
    log: Log
    repairs: tuple[Callable[[Log], Log], ...]
    problem: TorqueProblem
    robot: tuple[str, ...]
    columns: Array
    prior: Array
    fit: TorqueFit
    rows: np.ndarray


@dataclass(frozen=True)
class Choice:
    """The hypothesis that one round accepts.

    Attributes:
        tried: the hypothesis and its fit.
        alike: joints of those of its kind that explain exactly as much.
        alternatives: hypotheses of other kinds or joints that the log cannot tell from it.
    """

    tried: Tried
    alike: tuple[int, ...]
    alternatives: tuple[Tried, ...]


def explain(system: ConstrainedSystem, log: Log) -> Explanation:
    """Find the faults that explain the torque that the robot file leaves."""
    rows = log.rows(ROWS, margin=max(LAGS))
    problem = _weighed(problem_of(system, log, rows))
    kept, prior = np.zeros((*problem.r.shape, 0)), np.zeros(0)
    findings, taken, robot, repairs = [], set(), (), []
    for _ in range(ROUNDS):
        chosen = _best(system, log, rows, problem, kept, prior, taken)
        if chosen is None:
            break
        hypothesis, fit = chosen.tried
        finding = finding_of(system, log, hypothesis, fit, chosen.alike)
        others = [finding_of(system, log, *pair) for pair in chosen.alternatives]
        findings.append(with_alternatives(finding, others))
        taken.add((hypothesis.name, hypothesis.joints))
        if hypothesis.name not in ROBOT:
            theta = fit.theta
            if hypothesis.name == "encoder-offset":
                theta = _refined(system, log, rows, problem, hypothesis, theta[:1])
            repairs.append(partial(corrected, hypothesis=hypothesis, theta=theta))
            log = repairs[-1](log)
            problem = _weighed(problem_of(system, log, rows), kept, prior)
        else:
            assert hypothesis.columns is not None and hypothesis.prior is not None
            kept = np.concatenate([hypothesis.columns, kept], axis=-1)
            prior = np.concatenate([hypothesis.prior, prior])
            problem, robot = _weighed(problem, kept, prior), (hypothesis.name, *robot)
    return Explanation(
        findings, log, tuple(repairs), problem, robot, kept, prior, cross_validate(problem, kept, prior), rows
    )


def _refined(
    system: ConstrainedSystem,
    log: Log,
    rows: np.ndarray,
    problem: TorqueProblem,
    hypothesis: Hypothesis,
    theta: Array,
) -> Array:
    """An encoder offset after two more Gauss-Newton steps, as its effect on the torque is not linear."""
    for _ in range(2):
        moved = corrected(log, hypothesis, theta)
        refined = encoder_hypothesis(system, moved, rows, hypothesis.joints[0])
        theta = theta + cross_validate(with_log(problem, system, moved, rows), refined.columns).theta
    return theta


def _weighed(
    problem: TorqueProblem, columns: Array | None = None, prior: Array | None = None
) -> TorqueProblem:
    """The problem with joints weighed by the noise that the present explanation leaves."""
    for _ in range(2):
        error = cross_validate(problem, columns, prior).error
        # The typical block counts: a disturbance must not make a joint look noisy.
        noise = np.median(error, axis=0) * problem.scale
        problem = replace(problem, scale=np.maximum(noise, 1e-3 * problem.size))
    return problem


def _best(
    system: ConstrainedSystem,
    log: Log,
    rows: np.ndarray,
    problem: TorqueProblem,
    kept: Array,
    prior: Array,
    taken: set,
) -> Choice | None:
    """The simplest hypothesis within one standard error of the best, if it explains enough."""
    null = cross_validate(problem, kept, prior)
    tried = [
        (hypothesis, fit)
        for hypothesis, fit in _fits(system, log, rows, problem, kept, prior)
        if (hypothesis.name, hypothesis.joints) not in taken
    ]
    tried = [
        (hypothesis, fit)
        for hypothesis, fit in tried
        if plausible(system, hypothesis, fit)
        and not leaves_surface(system, log, corrected(log, hypothesis, fit.theta))
    ]
    good = [
        (hypothesis, fit)
        for hypothesis, fit in tried
        if significant(fit.shares, null.shares, len(hypothesis.joints) or log.nq)
    ]
    if not good:
        return None
    best = min(good, key=lambda pair: pair[1].score.mean())
    most, near = gain_of(best[1].score, null.score)[0], []
    for hypothesis, fit in good:
        loss, error = gain_of(best[1].score, fit.score)
        if loss <= max(error, SHARE * most) + 1e-9:
            near.append((hypothesis, fit))
    chosen, fit = min(near, key=lambda pair: (pair[0].size, pair[1].score.mean()))
    alike = [h.joints for h, other in near if h.name == chosen.name and _same(other, fit)]
    others = tuple(alternatives_of(system, (chosen, fit), tried, null))
    return Choice((chosen, fit), tuple(dict.fromkeys(j for joints in alike for j in joints)), others)


def _same(fit: TorqueFit, other: TorqueFit) -> bool:
    """Whether two fits leave the same errors but for rounding: those of an arm and of its mirror image."""
    return bool(np.allclose(fit.error, other.error, rtol=SAME, atol=0.0))


def _fits(
    system: ConstrainedSystem, log: Log, rows: np.ndarray, problem: TorqueProblem, kept: Array, prior: Array
) -> Iterator[tuple[Hypothesis, TorqueFit]]:
    # Once the robot is at fault and its parameters are free, they bend to any sign and order.
    for hypothesis in _promising(system, log, rows, problem) if not len(prior) else ():
        changed = with_log(problem, system, hypothesis.change(log), rows)
        yield hypothesis, cross_validate(changed)
    for hypothesis in delays(log) if len(prior) else ():
        # A delay leaves the motion, and with it the columns of the robot's parameters, as they are.
        yield hypothesis, cross_validate(with_log(problem, system, hypothesis.change(log), rows), kept, prior)
    tried = continuous(system, log, rows) if not len(prior) else robot_hypotheses(system, log, rows)
    null, off = cross_validate(problem, kept, prior), []
    for hypothesis in tried:
        fit = _fit(problem, hypothesis, kept, prior)
        yield hypothesis, fit
        if hypothesis.name == "gains" and significant(fit.shares, null.shares, 1):
            off += hypothesis.joints
    if len(off) > 1:
        together = gain_hypothesis(log, rows, tuple(off))
        yield together, _fit(problem, together, kept, prior)
    if 2 * len(off) > log.nq > 1:
        yield from _currents(log, rows, problem, kept, prior)


def _currents(
    log: Log, rows: np.ndarray, problem: TorqueProblem, kept: Array, prior: Array
) -> Iterator[Tried]:
    """Gains of all joints that the log determines, tried where most torques are scaled wrongly."""
    fit = _fit(problem, current_hypothesis(log, rows, problem, tuple(range(log.nq))), kept, prior)
    gains = 1.0 + fit.theta[: log.nq]
    determined = np.flatnonzero(np.abs(gains) > DETERMINED * fit.spread[: log.nq])
    # A current has the sign of its torque, so gains of both signs have another cause.
    if 2 * len(determined) > log.nq and (gains[determined] > 0.0).all():
        hypothesis = current_hypothesis(log, rows, problem, tuple(int(j) for j in determined))
        yield hypothesis, _fit(problem, hypothesis, kept, prior)


def _fit(problem: TorqueProblem, hypothesis: Hypothesis, kept: Array, prior: Array) -> TorqueFit:
    """A hypothesis with parameters, beside those that the model holds already."""
    assert hypothesis.columns is not None and hypothesis.prior is not None
    columns = np.concatenate([hypothesis.columns, kept], axis=-1)
    gains = hypothesis.joints if hypothesis.name == "gains" else ()
    every = np.concatenate([hypothesis.prior, prior])
    return cross_validate(problem, columns, every, gains, hypothesis.instruments)


def significant(better: Array, worse: Array, concerned: int) -> bool:
    """Whether a drop of the score matters for the number of joints concerned, and is not due to chance.

    Args:
        better, worse: `(blocks, nq)` errors as shares of the torque.
        concerned: number of joints.
    """
    least = max(MATERIAL, MATERIAL_EACH * concerned)
    gains = gain_of(score_of(better), score_of(worse)), pooled_gain_of(better, worse)
    # A drop that only quiet blocks show is an artefact of them: the other mean must bear it out.
    agree = all(gain > error for gain, error in gains)
    return gains[0][0] > least and agree and any(gain > SIGNIFICANT * error for gain, error in gains)


def _promising(
    system: ConstrainedSystem, log: Log, rows: np.ndarray, problem: TorqueProblem
) -> Iterator[Hypothesis]:
    """Hypotheses without parameters that lower the error on a part of the rows."""
    few = rows[::SCREENING]
    null = cross_validate(with_log(problem, system, log, few)).score.mean()
    for hypothesis in discrete(log):
        if cross_validate(with_log(problem, system, hypothesis.change(log), few)).score.mean() < null:
            yield hypothesis


Tried = tuple[Hypothesis, TorqueFit]
SMALL_MASS = 1e-6
"""Share of the robot's mass below which a mass is zero."""
ALONE = 2.0
"""Standard errors by which an alternative must lower the held-out error on its own.

The threshold is low (chance exceeds it in 4 % of cases), since it is already known that something is wrong.
"""
TESTS = {
    "torque-gain": "hang a known weight from the tip: its torque shows the gain, whatever the masses",
    "torque-current": "hang a known weight from the tip: its torque shows the gains, whatever the masses",
    "torque-sign": "push a joint in its positive direction while the arm holds still: its torque must fall",
    "torque-order": "twist one joint after another, without loading the others: only its torque must change",
    "torque-delay": "apply a torque step to one joint: its acceleration must change in the same sample",
    "torque-without-gravity": "hold the arm outstretched and still: the torque must balance gravity",
    "joint-sign": "turn one joint after another by hand, and watch the sign of its position",
    "joint-order": "turn one joint after another by hand, and watch which position changes",
    "encoder-offset": "move the joint to its zero mark: its position must be zero there",
    "base-tilted": "put a spirit level on the base",
    "gravity-direction": "check how the base is mounted",
    "payload-missing": "weigh what is mounted on the last link",
    "masses-mismatch": "compare the masses with the manufacturer's data",
}
"""A test for each kind of fault, in order of preference."""


def alternatives_of(
    system: ConstrainedSystem, chosen: Tried, tried: Iterable[Tried], null: TorqueFit
) -> Iterator[Tried]:
    """The hypotheses that the held-out blocks cannot distinguish from the chosen one.

    The best comes first. Each lowers the error significantly, and by as much as the chosen one to within one
    standard error of the difference over blocks.
    """
    for hypothesis, fit in sorted(tried, key=lambda one: one[1].score.mean()):
        if _says_the_same(chosen[0], hypothesis):
            continue
        gain, error = gain_of(fit.score, null.score)
        loss, tie = gain_of(chosen[1].score, fit.score)
        if gain > ALONE * error and abs(loss) <= tie and _possible(system, hypothesis, fit):
            yield hypothesis, fit


def _says_the_same(chosen: Hypothesis, other: Hypothesis) -> bool:
    """Whether a hypothesis has the kind and joints of the chosen one, or contains it, as masses do a tool."""
    if (chosen.name, other.name) == ("payload", "masses"):
        return True
    return other.name == chosen.name and (not other.joints or bool({*other.joints} & {*chosen.joints}))


def _possible(system: ConstrainedSystem, hypothesis: Hypothesis, fit: TorqueFit) -> bool:
    """Whether every link keeps a mass that is positive, or zero in the robot file; the fit does not enforce
    it."""
    if hypothesis.name != "masses":
        return True
    masses = system.robot.mass.numpy()
    fitted = masses + fit.theta[: 10 * system.robot.nq : 10]
    return bool(np.where(masses > 0.0, fitted > 0.0, fitted >= -SMALL_MASS * masses.sum()).all())


def with_alternatives(finding: Finding, others: Iterable[Finding]) -> Finding:
    """The finding with its alternatives, if there are any, and a test that tells them apart."""
    alternatives: list[Finding] = []
    for other in others:
        alike = (f for f in (finding, *alternatives) if f.kind == other.kind)
        if not any({*f.joints} & {*other.joints} or not other.joints for f in alike):
            alternatives.append(other)
    if not alternatives:
        return finding
    message = "; or ".join(one.message for one in (finding, *alternatives))
    test = next(TESTS[kind] for kind in TESTS if kind in {finding.kind, *(f.kind for f in alternatives)})
    return replace(finding, message=message, alternatives=tuple(alternatives), told_apart_by=test)
