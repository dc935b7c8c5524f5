"""Greedy search for faults that explain the torque.

Hypotheses are compared by cross-validation. The simplest one within one standard error of the best is
accepted (Breiman et al., *Classification and Regression Trees*, 1984, sec. 3.4.3), the log is corrected, and
the search is repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from forcegp.checks import hypotheses
from forcegp.checks.finding import Finding, with_alternatives
from forcegp.checks.fit import TorqueFit, TorqueProblem, cross_validate, gain_of, pooled_gain_of, score_of
from forcegp.checks.hypotheses import Hypothesis, corrected
from forcegp.checks.log import Array, Log
from forcegp.checks.placement import leaves_surface
from forcegp.constraints import ConstrainedSystem

ROWS, SCREENING, DELAYS = 1600, 4, 3
"""Number of rows used to test hypotheses; stride of the rows used for screening; delays kept per joint."""
MOST_FAULTS = 5
"""Maximum number of faults in the search."""
SCORE_Z = 4.0
"""Required drop in the held-out score, in standard errors, since about a hundred hypotheses are compared."""
SHARE, SAME = 0.03, 1e-3
"""Fraction of the best drop that a simpler hypothesis may miss; tolerance within which errors are equal."""
MATERIAL, MATERIAL_EACH = 0.15, 0.05
"""Minimum material drop in Σ_j log error: in total (14 % at one joint), and per affected joint."""

DISCRETE = ("torque-sign", "joint-sign", "torque-order", "joint-order")
"""Hypotheses that are not mistaken for friction."""
MAY_STICK = 0.5
"""Speed below which a joint may stick, relative to the speed at which dry friction has risen. With .2, .5
and 1, no wrong masses are reported in two logs of a UR5 with correct masses. Without it, they are in both."""

Tried = tuple[Hypothesis, TorqueFit]


@dataclass(frozen=True)
class Explanation:
    """Faults that explain the torque.

    Faults of the log are corrected in `log`. Hypotheses about the robot file, with their first rows in
    `robot`, stay in the model with their `columns` and `prior`. `problem` holds the remaining torques at
    `rows`. Calling `repairs` in order corrects the faults of any log.
    """

    system: ConstrainedSystem
    log: Log
    rows: np.ndarray
    problem: TorqueProblem
    columns: Array
    prior: Array
    robot: tuple[tuple[str, int], ...] = ()
    findings: tuple[Finding, ...] = ()
    repairs: tuple[Callable[[Log], Log], ...] = ()
    taken: frozenset[tuple[str, tuple[int, ...]]] = frozenset()

    @cached_property
    def fit(self) -> TorqueFit:
        """Fit of the current model to the remaining torques."""
        return cross_validate(self.problem, self.columns, self.prior)

    def on(self, log: Log, rows: np.ndarray | None = None) -> TorqueProblem:
        """Return the torque problem for a modified log, with the same weights and sizes of the torques.

        With other sizes, a correction that makes torques larger would make their errors smaller.
        """
        rows = self.rows if rows is None else rows
        problem = hypotheses.problem_of(self.system, log, rows, self.problem.scale)
        return replace(problem, size=self.problem.size)

    def weighed(self) -> Explanation:
        """Return the explanation with the joints weighted by their residual noise."""
        result = self
        for _ in range(2):
            # The typical block counts: a disturbance must not make a joint look noisy.
            noise = np.median(result.fit.error, axis=0) * result.problem.scale
            scale = np.maximum(noise, 1e-3 * result.problem.size)
            result = replace(result, problem=replace(result.problem, scale=scale))
        return result

    def beside(self, hypothesis: Hypothesis) -> Explanation:
        """Return the explanation with the parameters of a hypothesis placed before the existing ones."""
        assert hypothesis.columns is not None and hypothesis.prior is not None
        columns = np.concatenate([hypothesis.columns, self.columns], axis=-1)
        return replace(self, columns=columns, prior=np.concatenate([hypothesis.prior, self.prior]))

    def with_nuisance(self, *columns: Array) -> Explanation:
        """Return the explanation with additional columns that all hypotheses share."""
        nuisance = np.concatenate([self.problem.nuisance, *columns], axis=-1)
        return replace(self, problem=replace(self.problem, nuisance=nuisance))

    def without(self, columns: list[int]) -> Explanation:
        """Return the explanation with the given nuisance columns set to zero."""
        nuisance = self.problem.nuisance.copy()
        nuisance[..., columns] = 0.0
        return replace(self, problem=replace(self.problem, nuisance=nuisance))

    def with_(self, hypothesis: Hypothesis) -> TorqueFit:
        """Fit the parameters of a hypothesis in addition to those already in the model."""
        gains = hypothesis.joints if hypothesis.name == "gains" else ()
        wider = self.beside(hypothesis)
        return cross_validate(self.problem, wider.columns, wider.prior, gains, hypothesis.instruments)


def explain(system: ConstrainedSystem, log: Log) -> Explanation:
    """Find the faults that explain the torque left unexplained by the robot file."""
    rows = log.rows(ROWS, margin=max(hypotheses.LAGS))
    problem = hypotheses.problem_of(system, log, rows)
    model = Explanation(system, log, rows, problem, np.zeros((*problem.r.shape, 0)), np.zeros(0)).weighed()
    for _ in range(MOST_FAULTS):
        accepted = _round(model)
        if accepted is None:
            break
        model = accepted
    return model


def _round(model: Explanation) -> Explanation | None:
    """Accept the simplest hypothesis within one standard error of the best if the best explains enough."""
    system, log, null = model.system, model.log, model.fit
    fits = ((h, fit) for h, fit in _fits(model) if (h.name, h.joints) not in model.taken)
    fits = ((h, fit) for h, fit in fits if hypotheses.plausible(system, h, fit))
    tried = [(h, fit) for h, fit in fits if not leaves_surface(system, log, corrected(log, h, fit.theta))]
    good = [(h, fit) for h, fit in tried if significant(fit.shares, null.shares, len(h.joints) or log.nq)]
    good = [(h, fit) for h, fit in good if h.name in DISCRETE or _while_moving(model, h)]
    if model.findings and not any(finding.kind.endswith("order") for finding in model.findings):
        # An exchange may improve one joint only if it continues a permutation.
        good = [(h, fit) for h, fit in good if not h.name.endswith("order") or _helps_each(h, fit, null)]
    if not good:
        return None
    best = min((fit for _, fit in good), key=lambda fit: fit.score.mean())
    most = gain_of(best.score, null.score)[0]
    losses = ((one, *gain_of(best.score, one[1].score)) for one in good)
    near = [one for one, loss, error in losses if loss <= max(error, SHARE * most) + 1e-9]
    chosen, fit = min(near, key=lambda pair: (pair[0].size, pair[1].score.mean()))
    if chosen.name == "encoder-offset":
        fit = _refined(model, chosen, fit)
        if not hypotheses.plausible(system, chosen, fit):
            return replace(model, taken=model.taken | {(chosen.name, chosen.joints)})
    # The errors of an arm and of its mirror image are equal but for rounding.
    twins = (h for h, its in near if h.name == chosen.name and np.allclose(its.error, fit.error, SAME, 0.0))
    alike = tuple(dict.fromkeys(joint for twin in twins for joint in twin.joints))
    finding = hypotheses.finding_of(system, log, chosen, fit, alike)
    alternatives = alternatives_of(system, (chosen, fit), tried, null)
    finding = with_alternatives(finding, [hypotheses.finding_of(system, log, *pair) for pair in alternatives])
    return _accepted(model, chosen, fit.theta, finding)


def _helps_each(exchange: Hypothesis, fit: TorqueFit, null: TorqueFit) -> bool:
    """Return whether an exchange of two joints lowers the typical error of both."""
    better, worse = (np.median(one.shares[:, list(exchange.joints)], axis=0) for one in (fit, null))
    return bool((better < worse).all())


def _accepted(model: Explanation, hypothesis: Hypothesis, theta: Array, finding: Finding) -> Explanation:
    """Return the explanation with the fault corrected, or with its parameters added to the model."""
    taken = model.taken | {(hypothesis.name, hypothesis.joints)}
    model = replace(model, findings=(*model.findings, finding), taken=taken)
    if hypothesis.name in (*hypotheses.ROBOT, hypotheses.CHANGE):
        group = hypothesis.name, hypothesis.first
        return replace(model.beside(hypothesis), robot=(group, *model.robot)).weighed()
    repair = partial(corrected, hypothesis=hypothesis, theta=theta)
    log = repair(model.log)
    problem = hypotheses.problem_of(model.system, log, model.rows)
    return replace(model, log=log, problem=problem, repairs=(*model.repairs, repair)).weighed()


def _refined(model: Explanation, hypothesis: Hypothesis, fit: TorqueFit) -> TorqueFit:
    """Refine an encoder offset, which has a nonlinear effect on the torque, by Gauss-Newton steps."""
    theta = fit.theta[:1]
    for _ in range(2):
        moved = corrected(model.log, hypothesis, theta)
        refined = hypotheses.encoder_hypothesis(model.system, moved, model.rows, hypothesis.joints[0])
        theta = theta + cross_validate(model.on(moved), refined.columns).theta
    return replace(fit, theta=np.concatenate([theta, fit.theta[1:]]))


def _fits(model: Explanation) -> Iterator[Tried]:
    system, log, rows = model.system, model.log, model.rows
    if len(model.prior):
        # Once the robot is at fault and its parameters are free, they bend to any sign and order. A delay
        # leaves the motion, and with it the columns of the robot's parameters, as they are.
        for late in _delays(model):
            yield late, cross_validate(model.on(late.change(log)), model.columns, model.prior)
        tried = hypotheses.robot_hypotheses(system, log, rows)
    else:
        few = model.rows[::SCREENING]
        null = cross_validate(model.on(log, few)).score.mean()
        for hypothesis in (*hypotheses.discrete(system, log), *_delays(model)):
            changed = hypothesis.change(log)
            if cross_validate(model.on(changed, few)).score.mean() < null:
                yield hypothesis, cross_validate(model.on(changed))
        tried = hypotheses.continuous(system, log, rows)
    off = []
    for hypothesis in tried:
        fit = model.with_(hypothesis)
        if hypotheses.is_tilt(system, hypothesis, fit) and not _beside_size(model, hypothesis, fit):
            continue
        yield hypothesis, fit
        if hypothesis.name == "gains" and significant(fit.shares, model.fit.shares, 1):
            off += hypothesis.joints
    if len(off) > 1:
        together = hypotheses.gain_hypothesis(log, rows, tuple(off))
        yield together, model.with_(together)
    if 2 * len(off) > log.nq > 1:
        yield from _currents(model)


def _delays(model: Explanation) -> Iterator[Hypothesis]:
    """Yield the delays, common or of one torque, that leave least unexplained in the screened rows."""
    log, few = model.log, model.rows[::SCREENING]
    problem, columns = model.on(log, few), model.columns[::SCREENING]
    null = cross_validate(problem, columns, model.prior).score.mean()
    alone = [(j,) for j in range(log.nq if log.nq > 1 else 0)]
    for joints in ((), *alone) if log.stretches else ():
        scores, only = {}, np.isin(np.arange(log.nq), joints) | (not joints)
        for shift in (*hypotheses.LAGS, *([] if joints else [-lag for lag in hypotheses.LAGS])):
            r = problem.r + only * (log.tau[few] - log.tau[few + shift])
            scores[shift] = cross_validate(replace(problem, r=r), columns, model.prior).score.mean()
        for shift in sorted((k for k in scores if scores[k] < null), key=scores.__getitem__)[:DELAYS]:
            change = partial(hypotheses.delayed, shift=shift, joints=joints)
            yield Hypothesis("torque-delay", 1, change, joints=joints, shift=shift)


def _while_moving(model: Explanation, hypothesis: Hypothesis) -> bool:
    """Return whether a hypothesis explains the torques of moving joints, if joints move in most rows.

    At rest, dry friction may have any value, and joints reverse where they accelerate most, so an error of
    friction resembles one of the masses. If parameters of the robot are fitted, so is the shape of friction.
    """
    log, rows = model.log, model.rows
    shapes = hypotheses.shape_columns(model.system, log, rows)[..., : None if len(model.prior) else 0]
    moving = np.abs(log.qd[rows]) > MAY_STICK * model.system.robot.friction_velocity.numpy()
    moving |= moving.mean() <= 0.5

    def at(changed: Log) -> Explanation:
        columns = model.columns * moving[..., None]
        wider = replace(model, problem=model.on(changed)).with_nuisance(shapes)
        return replace(wider, problem=wider.problem.at(moving), columns=columns)

    null = at(log)
    if hypothesis.columns is None:
        better = at(hypothesis.change(log)).fit
    else:
        pair = hypothesis.columns, hypothesis.instruments
        columns, instruments = (None if x is None else x * moving[..., None] for x in pair)
        better = null.with_(replace(hypothesis, columns=columns, instruments=instruments))
    return significant(better.shares, null.fit.shares, len(hypothesis.joints) or log.nq)


def _beside_size(model: Explanation, tilt: Hypothesis, fit: TorqueFit) -> bool:
    """Return whether changing the size of gravity, as wrong masses seem to do, explains less than a tilt."""
    assert tilt.columns is not None and tilt.prior is not None
    along = model.system.robot.gravity.numpy()[:, None]
    size = model.with_(replace(tilt, columns=tilt.columns @ along, prior=tilt.prior[:1]))
    return significant(fit.shares, size.shares, model.log.nq)


def _currents(model: Explanation) -> Iterator[Tried]:
    """Yield the hypothesis that all torques with a determined gain are scaled if they form the majority."""
    log, rows, nq = model.log, model.rows, model.log.nq
    fit = model.with_(hypotheses.current_hypothesis(log, rows, model.problem, tuple(range(nq))))
    gains = 1.0 + fit.theta[:nq]
    determined = np.flatnonzero(np.abs(gains) > fit.spread[:nq])
    # A current has the sign of its torque, so gains of both signs have another cause.
    if 2 * len(determined) > nq and (gains[determined] > 0.0).all():
        hypothesis = hypotheses.current_hypothesis(log, rows, model.problem, tuple(determined.tolist()))
        yield hypothesis, model.with_(hypothesis)


def significant(better: Array, worse: Array, concerned: int) -> bool:
    """Return whether a decrease in the score is material and significant, given errors (blocks, nq)."""
    least = max(MATERIAL, MATERIAL_EACH * concerned)
    gains = gain_of(score_of(better), score_of(worse)), pooled_gain_of(better, worse)
    # A decrease in both means is required, since quiet blocks alone may cause a decrease in one.
    agree = all(gain > error for gain, error in gains)
    return gains[0][0] > least and agree and any(gain > SCORE_Z * error for gain, error in gains)


SMALL_MASS = 1e-6
"""Fraction of the robot's mass below which a mass counts as zero."""
ALONE = 2.0
"""Number of standard errors by which an alternative must lower the held-out error on its own. Chance exceeds
it in 4 % of cases. This suffices because something is already known to be wrong."""


def alternatives_of(
    system: ConstrainedSystem, chosen: Tried, tried: Iterable[Tried], null: TorqueFit
) -> Iterator[Tried]:
    """Yield the hypotheses within one standard error of the chosen one on held-out blocks, best first.

    Hypotheses of the same kind that share joints with the chosen one are omitted. So are hypotheses that
    contain the chosen one (for example, masses contain a payload).
    """
    name, joints = chosen[0].name, {*chosen[0].joints}
    for hypothesis, fit in sorted(tried, key=lambda one: one[1].score.mean()):
        same = name == hypothesis.name and (not hypothesis.joints or bool(joints & {*hypothesis.joints}))
        if same or (name, hypothesis.name) == ("payload", "masses"):
            continue
        gain, error = gain_of(fit.score, null.score)
        loss, tie = gain_of(chosen[1].score, fit.score)
        if gain > ALONE * error and abs(loss) <= tie and _possible(system, hypothesis, fit):
            yield hypothesis, fit


def _possible(system: ConstrainedSystem, hypothesis: Hypothesis, fit: TorqueFit) -> bool:
    """Return whether every link keeps a positive mass, or zero mass if it has none in the robot file."""
    if hypothesis.name != "masses":
        return True
    masses = system.robot.mass.numpy()
    fitted = masses + fit.theta[: 10 * system.robot.nq : 10]
    return bool(np.where(masses > 0.0, fitted > 0.0, fitted >= -SMALL_MASS * masses.sum()).all())
