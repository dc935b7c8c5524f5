"""Checks of the torque for faults that explain it, and for friction, offsets and disturbances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import minimum_filter1d

from forcegp import dynamics
from forcegp.checks import hypotheses
from forcegp.checks.excitation import check_visibility, still_joints
from forcegp.checks.explain import Explanation, explain
from forcegp.checks.finding import Finding, NotJudgedError, with_alternatives
from forcegp.checks.fit import (
    FLOOR,
    TorqueFit,
    gain_of,
    jackknife,
    labelled_contacts,
    residual,
    robust_parameters,
)
from forcegp.checks.log import Array, Log, Outcome, force_unit, position_unit, smoothed
from forcegp.constraints import ConstrainedSystem
from forcegp.robust import robust_std
from forcegp.rows import describe, intervals

MODELLED, TOUCHED = 0.02, 0.1
"""Largest difference between a modelled torque and the inverse dynamics, relative to the torque; share of
rows in contact, or with friction above twice that difference, that would show in a measured torque."""
LEAST_ROWS = 200
"""Minimum number of rows for checking the dynamics."""
DROP_Z, MATERIAL = 3.0, 0.1
"""Standard errors over blocks, and drop in a joint's log error, above which friction or offsets count."""
SPEEDS, UNEXPLAINED = (25.0, 95.0), 0.5
"""Percentiles of speed at which friction must oppose motion; accepted RMS fraction of unexplained torque."""
TRACE_ROWS, DISTURBANCE_SECONDS = 20_000, 0.1
"""Maximum number of rows in the trace of the residual; duration over which the residual is averaged [s]."""
DISTURBANCE, LOUD = 5.0, 4.0
"""A period stands out if its log residual exceeds the median by this many robust standard deviations, or if
its residual exceeds the 90 % quantile by this factor."""
MOVING, VISIBLE = 0.05, 0.1
"""Fraction of its maximum speed above which an arm moves; fraction of torque that a disturbance exceeds."""
ONE_SIGMA = 84.13
"""Percentile of a normal distribution at one standard deviation above the mean."""


def check_dynamics(system: ConstrainedSystem, log: Log) -> Outcome:
    """Check the torques for wrong signs, order, gains and delays, and the robot file for wrong parameters."""
    if len(log.rows(LEAST_ROWS)) < LEAST_ROWS:
        raise NotJudgedError(f"fewer than {LEAST_ROWS} usable rows")
    if log.header.servo_stiffness:
        raise NotJudgedError("torques follow from nominal gains, whose errors a fit learns")
    if system.robot.coupling is not None:
        raise NotJudgedError("torques of coupled drives are not compared with friction of joints")
    passive = _without_torque(log)
    if any(finding.severity == "error" for finding in passive):
        return passive, log
    smooth = smoothed(log)
    if not _enough(smooth):
        inner = f"rows that lie {max(hypotheses.LAGS)} from the ends of a stretch"
        raise NotJudgedError(f"fewer than {LEAST_ROWS} {inner}")
    if modelled := _modelled(system, smooth):
        return [*passive, *modelled], log
    explanation = explain(system, smooth)
    disturbed, rows = _disturbances(explanation) if log.header.ordered else ([], np.zeros(0, bool))
    if disturbed and _enough(smooth.mask(rows)):
        # A disturbance must not be mistaken for friction or for a mass.
        explanation = explain(system, smooth.mask(rows))
    losses = _determined(explanation)
    # Contact friction, or a steeper rise of declared friction, must not be mistaken for additional friction.
    functions = (hypotheses.contact_friction_columns, hypotheses.other_rise_columns)
    shapes = [columns(system, explanation.log, explanation.rows) for columns in functions]
    findings = [
        *passive,
        *_confounded(explanation),
        *_friction(_determined(explanation.with_nuisance(*shapes)), _with_any_rise(explanation)),
        *_offsets(losses),
        *_unexplained(explanation),
        *check_visibility(explanation),
    ]
    for repair in explanation.repairs:
        log = repair(log)
    if log.contact and log.nq > 3:
        # Joint friction and offsets must not be mistaken for a force at the tip.
        viscous, dry, offset = losses.fit.nuisance.reshape(3, log.nq)
        smooth = np.tanh(log.qd / system.robot.friction_velocity.numpy())
        log = log.replace(tau=log.tau + viscous * log.qd + dry * smooth + offset)
    return [*findings, *disturbed], log


def _enough(log: Log) -> bool:
    return len(log.rows(LEAST_ROWS, margin=max(hypotheses.LAGS))) == LEAST_ROWS


def _without_torque(log: Log) -> list[Finding]:
    """Find torques that are constant although the joint moves."""
    tau = log.tau[log.usable]
    still = (np.ptp(tau, axis=0) == 0.0) & (np.ptp(log.q[log.usable], axis=0) > 0.0)
    still[log.unmeasured] = False
    word = "constant" if tau[:, still].any() else "zero"
    findings = log.on_joints("torque-zero", still, f"the torque of {{}} is {word} throughout")
    # One passive joint is a design; an arm without any torque is a missing column.
    return [replace(finding, weight="error" if still.all() else "warning") for finding in findings]


def _modelled(system: ConstrainedSystem, log: Log) -> list[Finding]:
    """Find torques that are the inverse dynamics of the robot file: no drive is free of friction.

    In free motion of a robot file without damping, a simulated torque is the same, so this is a note.
    """
    rows = log.rows(2 * LEAST_ROWS)
    r, _ = residual(system, log, rows)
    (qd,) = log.tensors(rows, "qd")
    damping = dynamics.damping_force(system.robot, qd).detach().numpy()
    size = np.sqrt((log.tau[rows] ** 2).mean(axis=0))
    measured = np.setdiff1d(np.flatnonzero(size > 0.0), log.unmeasured)

    def equal(rest: Array) -> bool:
        scale = np.maximum(size, 0.1 * size.max())[measured]
        return bool((np.sqrt(np.median(rest[:, measured] ** 2, axis=0)) <= MODELLED * scale).all())

    closed = np.any([log.contact[c.name][rows] for c in labelled_contacts(system, log)], axis=0)
    rest = r + damping
    if not len(measured) or not equal(rest):
        return []
    touching = bool(np.mean(closed) > TOUCHED) and equal(rest[closed])
    fast = np.abs(damping) > 2.0 * MODELLED * np.maximum(size, 0.1 * size.max())
    damped = bool(fast.mean() > TOUCHED) and equal(rest[fast.any(axis=1)])
    if not touching and not damped:
        return []
    signs = {"no contact force in contact": touching, "none of the declared friction": damped}
    reasons = [sign for sign, seen in signs.items() if seen]
    text = "the logged torque is the inverse dynamics of the robot file to within "
    text += f"{100 * MODELLED:.0f} %, with {' and '.join(reasons)}: a model's output, not a measurement"
    return [log.finding("torque-modelled", text, log.named(np.isin(np.arange(log.nq), measured)))]


def _worse(explanation: Explanation, other: TorqueFit, j: int) -> bool:
    """Return whether another fit has a significantly larger error at joint j."""
    floor = FLOOR * explanation.problem.size[j] / explanation.problem.scale[j]
    gain, error = gain_of(*(np.log(np.hypot(fit.error[:, j], floor)) for fit in (explanation.fit, other)))
    return gain > MATERIAL and gain > DROP_Z * error


def _determined(explanation: Explanation) -> Explanation:
    """Set friction to 0 if it would drive a joint, or if it is smaller than its standard deviation."""
    robot = explanation.system.robot
    declared = np.concatenate([robot.damping.numpy(), robot.friction.numpy()])
    for _ in range(robot.nq):
        fit = explanation.fit
        change, spread = -fit.nuisance[: len(declared)], fit.nuisance_spread[: len(declared)]
        wrong = (change != 0.0) & ((change + declared < -spread) | (np.abs(change) <= spread))
        if not wrong.any():
            break
        explanation = explanation.without(np.flatnonzero(wrong).tolist())
    return explanation


def _confounded(explanation: Explanation) -> list[Finding]:
    """Return the findings. Currents become warnings if masses are wrong, since gains depend on masses."""
    findings = list(explanation.findings)
    for k, finding in enumerate(findings if ("masses", 0) in explanation.robot else ()):
        if finding.kind == "torque-current" and "masses-mismatch" not in finding.kinds:
            text = f"{finding.message}; or the masses, which do not fit either, are to blame for both"
            findings[k] = replace(finding, message=text, weight="warning")
    return findings


def _with_any_rise(explanation: Explanation) -> Explanation:
    """Return the explanation in which dry friction of joints and contacts may have any slope near rest.

    The slopes do not change the friction of a fast joint, whose value and error then hold for any of them.
    Dry friction is at most as large as the torque.
    """
    system, log, rows = explanation.system, explanation.log, explanation.rows
    count = len(hypotheses.RISES)
    rises = hypotheses.shape_columns(system, log, rows)[..., : count * log.nq]
    prior = np.tile(explanation.problem.size, count)
    wider = replace(
        explanation,
        columns=np.concatenate([rises, explanation.columns], axis=-1),
        prior=np.concatenate([prior, explanation.prior]),
    )
    return wider.with_nuisance(hypotheses.contact_friction_columns(system, log, rows))


def rounded(error: float) -> str:
    """Return a standard error with two digits, without an exponent.

    >>> rounded(14.3), rounded(0.0083)
    ('14', '0.0083')
    """
    return f"{float(f'{error:.2g}'):g}"


def _stated(stated: Explanation, j: int, speed: float) -> tuple[dict[str, float], str]:
    """Return the viscous and Coulomb friction of a joint if determined, otherwise their sum at a speed."""
    robot, nq, fit = stated.system.robot, stated.log.nq, stated.fit
    declared = np.array([float(robot.damping[j]), float(robot.friction[j])])
    total, without = (declared - x[..., [j, nq + j]] for x in (fit.nuisance, fit.nuisance_without))
    unit, per = force_unit(robot, j), position_unit(robot, j)
    kinds, errors, units = ("viscous", "coulomb"), jackknife(without), (f"{unit} s/{per}", unit)
    at = np.array([speed, 1.0])
    together, error = float(total @ at), float(jackknife(without @ at[:, None])[0])
    if together <= 2.0 * error:
        return {}, "not determined"
    known = [k for k in range(2) if total[k] > 2.0 * errors[k]]
    texts = [f"{total[k]:.3g} ± {rounded(errors[k])} {units[k]}" for k in known]
    if len(known) < 2:
        texts.append(f"together {together:.3g} {unit} (± {rounded(error)}) at {speed:.2g} {per}/s")
    return {kinds[k]: float(total[k]) for k in known}, ", ".join(texts)


def _friction(explanation: Explanation, stated: Explanation) -> list[Finding]:
    """Return the joints whose friction is not that of the robot file, with the friction in a `stated` fit."""
    robot, log, nq = explanation.system.robot, explanation.log, explanation.log.nq
    viscous, coulomb = -explanation.fit.nuisance[:nq], -explanation.fit.nuisance[nq : 2 * nq]
    rows = log.qd[explanation.rows]
    power = (viscous * rows**2 + coulomb * np.abs(rows)).mean(axis=0)
    # What drives a joint at some speed, declared friction included, is an error of the model, not friction.
    speeds = np.percentile(np.abs(rows), SPEEDS, axis=0)
    damping, declared = robot.damping.numpy(), robot.friction.numpy()
    resists = ((viscous + damping) * speeds + coulomb + declared > 0.0).all(axis=0)
    significant = np.array([_worse(explanation, explanation.without([j, nq + j]).fit, j) for j in range(nq)])
    # At speeds where declared friction is still rising, additional friction cannot be distinguished from it.
    rising = (speeds[1] <= robot.friction_velocity.numpy()) & (declared > 0.0)
    significant &= resists & ~still_joints(log) & ~rising
    findings = []
    for hit, word in ((significant & (power > 0.0), "more"), (significant & (power <= 0.0), "less")):
        largest = (np.abs(viscous) * speeds[1] + np.abs(coulomb))[hit].max(initial=0.0)
        evidence, parts = {"largest_torque": largest}, []
        for j in np.flatnonzero(hit).tolist():
            sizes, text = _stated(stated, j, float(np.sqrt((rows[:, j] ** 2).mean())))
            evidence |= {f"{kind} {log.joint_names[j]}": x for kind, x in sizes.items()}
            parts.append(f"{log.joint_names[j]} {text}")
        text = f"{'; '.join(parts)}: friction, {word} than the robot file declares"
        findings += [log.finding("friction-undeclared", text, log.named(hit), **evidence)] if parts else []
    return findings


def _offsets(explanation: Explanation) -> list[Finding]:
    system, log, rows, nq = explanation.system, explanation.log, explanation.rows, explanation.log.nq
    offset = -explanation.fit.nuisance[2 * nq : 3 * nq]
    known = np.abs(offset) > explanation.fit.nuisance_spread[2 * nq : 3 * nq]
    less = {j: explanation.without([2 * nq + j]) for j in np.flatnonzero(known).tolist()}
    off = {j: log.joint_names[j] for j, one in less.items() if _worse(explanation, one.fit, j)}
    if not off:
        return []
    listed = ", ".join(f"{joint} {offset[j]:+.3g} {force_unit(system.robot, j)}" for j, joint in off.items())
    evidence = {f"offset {joint}": offset[j] for j, joint in off.items()}
    evidence["largest_torque"] = max(abs(offset[j]) for j in off)
    text, names = f"{listed}: constant error of the logged torque", tuple(off.values())
    common = [hypotheses.common_gain_hypothesis(log, rows, explanation.problem)] if nq > 1 else []
    one_each = hypotheses.gain_hypothesis(log, rows, tuple(off))
    tried = *common, *hypotheses.robot_hypotheses(system, log, rows), one_each
    without = explanation.without([2 * nq + j for j in off])
    fits = ((h, without.with_(h)) for h in tried if (h.name, h.first) not in explanation.robot)
    rivals = [
        hypotheses.finding_of(system, log, h, fit)
        for h, fit in fits
        if hypotheses.plausible(system, h, fit) and not any(_worse(explanation, fit, j) for j in off)
    ]
    if (weightless := _weightless(explanation, list(off))) is not None:
        rivals = [weightless, *(f for f in rivals if f.kind != weightless.kind)]
    # One cause that takes the place of the offsets of several joints is named before them.
    findings = [log.finding("torque-offset", text, names, **evidence), *rivals]
    single = [f for f in rivals if f.kind == "torque-without-gravity" or "factor" in f.evidence]
    first = (single or findings)[0]
    return [with_alternatives(first, [f for f in findings if f is not first])]


def _weightless(explanation: Explanation, off: list[int]) -> Finding | None:
    """Return the finding that adding the gravity torque explains as much as the offsets of these joints."""
    log, nq = explanation.log, explanation.log.nq
    whole = hypotheses.restored(log, explanation.system.robot, "gravity")
    offset = -explanation.fit.nuisance[2 * nq :][off]
    usual = (log.tau - whole.tau)[explanation.rows][:, off].mean(axis=0)
    added = replace(explanation, problem=explanation.on(whole))
    fit = added.without([2 * nq + j for j in off]).fit
    if (np.abs(offset - usual) > UNEXPLAINED * np.abs(offset)).any() or any(
        _worse(explanation, fit, j) for j in off
    ):
        return None
    text = hypotheses.DISCRETE["torque-without-gravity"].format("all joints")
    return log.finding("torque-without-gravity", text, log.joint_names)


def _unexplained(explanation: Explanation) -> list[Finding]:
    """Report an arm, or single joints, if most of the torque is unexplained."""
    log, size = explanation.log, explanation.problem.size
    error = np.median(explanation.fit.error, axis=0) * explanation.problem.scale
    share = float(np.sqrt((error**2).sum() / (size**2).sum()))
    text = f"robot file, friction and offsets leave {100 * share:.0f} % of the torque unexplained"
    if share > UNEXPLAINED:
        return [log.finding("torque-unexplained", text, share=share)]
    each = error / size
    wrong = (each > UNEXPLAINED) & (size > FLOOR * size.max())
    parts = ", ".join(f"{log.joint_names[j]} {100 * each[j]:.0f} %" for j in np.flatnonzero(wrong))
    text = f"robot file, friction and offsets leave most of the torque of some joints unexplained: {parts}"
    return log.on_joints("joint-unexplained", wrong, text)


def _disturbances(explanation: Explanation) -> tuple[list[Finding], np.ndarray]:
    """Find periods with far more unexplained torque than usual, and mask the rows around them."""
    robot, log, rows = explanation.system.robot, explanation.log, explanation.log.rows(TRACE_ROWS)
    trace = residual_trace(explanation, rows)
    scale = np.maximum(explanation.problem.scale, FLOOR * explanation.problem.size)
    stride = np.median(np.diff(rows)) * log.dt
    width = min(max(1, round(DISTURBANCE_SECONDS / stride)), len(rows))
    energy = np.convolve(((trace / scale) ** 2).mean(axis=1), np.ones(width) / width, mode="same")
    level = np.log(energy + FLOOR**2)
    # Dry friction of joints that rest or reverse within the window may be as large as this.
    dry = robot.friction.numpy() - explanation.fit.nuisance[log.nq : 2 * log.nq]
    slowest = minimum_filter1d(np.abs(log.qd[rows]), 2 * width + 1, axis=0)
    friction = np.maximum(dry, 0.0) * (slowest < robot.friction_velocity.numpy())
    size = np.maximum(explanation.problem.size, FLOOR * explanation.problem.size.max())
    visible = np.asarray((np.abs(trace) > VISIBLE * size + friction).any(axis=1))
    bad = _stands_out(log, rows, level)
    spans = [(a, b) for a, b in intervals(bad, width, least=width) if visible[a:b].mean() > 0.5]
    mask = np.zeros(len(log), bool)
    if not spans:
        return [], mask
    for a, b in spans:
        mask[rows[max(a - width, 0)] : rows[min(b + width, len(rows)) - 1] + 1] = True
    whole = tuple((int(rows[a]), int(rows[b - 1]) + 1) for a, b in spans)
    worst = int(np.argmax((np.abs(trace) / scale)[bad].max(axis=0)))
    peak = float(np.abs(trace[bad][:, worst]).max())
    text = (
        f"torque of up to {peak:.3g} {force_unit(robot, worst)} at {log.joint_names[worst]} that "
        f"{'neither robot nor labelled contacts explain' if log.contact else 'the robot does not explain'}, "
        f"in {describe(whole)}"
    )
    return [Finding("disturbance", text, whole, (log.joint_names[worst],), evidence={"peak": peak})], mask


def _stands_out(log: Log, rows: np.ndarray, level: Array) -> np.ndarray:
    """Return a mask (n,) of rows with a larger residual than usual for the same contact state."""
    # The residual of an arm at rest is small and is no reference for an arm in motion.
    speed = np.abs(log.qd[rows]).max(axis=1)
    moving, bad = speed >= MOVING * np.percentile(speed, 99), np.zeros(len(rows), bool)
    labels = [label[rows] for label in log.contact.values()]
    state = np.unique(np.array(labels), axis=1, return_inverse=True)[1].ravel() if labels else 0 * level
    for number in np.unique(state):
        here = state == number
        usual = level[here & moving]
        if len(usual) < LEAST_ROWS:
            usual = level[moving]
        closed = any(label[here].any() for label in labels)
        spread = _upper_spread(usual) if closed else float(robust_std(usual))
        most = np.median(usual) + DISTURBANCE * max(spread, 0.2)
        bad[here] = level[here] > min(most, np.percentile(usual, 90) + 2.0 * np.log(LOUD))
    return bad


def _upper_spread(level: Array) -> float:
    """Return the spread above the median if it is smaller: log sums of few squares have a long lower tail."""
    middle, upper = np.percentile(level, [50.0, ONE_SIGMA])
    return float(min(robust_std(level), upper - middle))


def residual_trace(explanation: Explanation, rows: np.ndarray) -> Array:
    """Return the residual torque (n, nq) at the given rows [N m, N]. It excludes contact forces."""
    system, log = explanation.system, explanation.log
    parts, coefficients = [], robust_parameters(explanation.problem, explanation.columns, explanation.prior)
    for index in np.array_split(rows, max(1, len(rows) // 2048)):
        part = explanation.on(log, index)
        columns = [hypotheses.robot_columns(system, log, index, *group)[0] for group in explanation.robot]
        r = part.r - np.concatenate([*columns, part.nuisance], axis=-1) @ coefficients
        parts.append(part.without_contact(r[..., None])[..., 0] * part.scale)
    return np.concatenate(parts)
