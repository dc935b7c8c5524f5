"""Information that the motion contains about the robot.

The checks determine which joints move and reverse, which parameters can be identified, and how large a fault
must be for the log to reveal it. A fault of size θ adds θ φ to the unexplained torque r, and the held-out
residual e is linear: e(r + θ φ) = e(r) + θ e(φ). The fault counts as detected if `explain.significant`
accepts the increase in the residual.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from forcegp.checks.contact import LEAST_ROWS
from forcegp.checks.explain import Explanation, significant
from forcegp.checks.finding import Finding
from forcegp.checks.fit import blocks_of, cross_validate, held_out, residual
from forcegp.checks.hypotheses import encoder_hypothesis, inertial_spread, robot_columns
from forcegp.checks.log import Array, Log, Outcome, position_unit
from forcegp.constraints import ConstrainedSystem
from forcegp.identification import base_parameters, parameter_vector, regressor

STILL = 0.05
"""Range of motion below which a joint counts as stationary [rad, m]."""
REVERSALS, HYSTERESIS = 4, 0.05
"""Number of reversals needed to separate Coulomb friction from a torque offset; fraction of its largest speed
that a joint must reach for a reversal to count."""
SHORT_SECONDS, ROWS = 2.0, 1000
"""Duration below which a log contains little information [s]; maximum number of rows in the regressor."""
LOOK, LEARNED = 0.1, 0.5
"""Time after which the torque provides new information [s]; ratio of posterior to prior standard deviation
below which a parameter counts as identified."""


def check_length(system: ConstrainedSystem, log: Log) -> Outcome:
    """Check whether the log is long enough."""
    seconds = len(log.rows(len(log))) * log.dt if np.isfinite(log.dt) else 0.0
    short = log.finding("log-short", f"{seconds:.3g} s of the log can be used", seconds=seconds)
    return [short] if log.header.ordered and seconds < SHORT_SECONDS else [], log


def still_joints(log: Log) -> np.ndarray:
    """Return the mask `(nq,)` of joints that do not move."""
    return log.reach("q") < STILL if log.usable.any() else np.zeros(log.nq, bool)


def check_motion(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find joints that do not move or rarely change direction."""
    still = still_joints(log)
    unit = " or ".join(dict.fromkeys(position_unit(system.robot, j) for j in np.flatnonzero(still)))
    text = f"{{}}: range below {STILL} {unit}, too small to see friction and inertia"
    findings = log.on_joints("joint-still", still, text)
    if not log.header.ordered:
        return findings, log
    turns = np.zeros(log.nq, int)
    fast = HYSTERESIS * np.percentile(np.abs(log.qd[log.usable]), 99, axis=0)
    for j, x in ((j, log.qd[s, j]) for s in log.stretches for j in range(log.nq)):
        turns[j] += np.count_nonzero(np.diff(np.sign(x[np.abs(x) > fast[j]])))
    text = f"{{}}: fewer than {REVERSALS} changes of direction: friction looks like an offset"
    return findings + log.on_joints("few-reversals", (turns < REVERSALS) & ~still, text), log


def check_excitation(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find base parameters that the log does not determine, and the motion that would determine them."""
    rows = log.rows(ROWS)
    if len(rows) < 50 or still_joints(log).all():
        return [], log
    sharpness, names, columns = _sharpness(system, log, rows)
    if not (weak := sharpness > LEARNED).any():
        return [], log
    joints = np.unique(columns[weak] // 10)
    listed = ", ".join(names[k] for k in np.flatnonzero(weak)[:6])
    more = f" and {weak.sum() - 6} more" if weak.sum() > 6 else ""
    count = f"{weak.sum()} of {len(weak)} base parameters are not identified"
    # The motion that would reveal the parameters of these links.
    reach, push = np.ptp(log.q[log.usable], axis=0), np.sqrt((log.qdd[log.usable] ** 2).mean(axis=0))
    narrow = [log.joint_names[j] for j in joints if reach[j] < 0.5]
    slow = [log.joint_names[j] for j in joints if push[j] < 1.0]
    pairs = ("larger range", narrow), ("faster changes of speed", slow)
    parts = [f"{what} of {', '.join(few[:3])}" for what, few in pairs if few]
    missing = "; ".join(parts) or "other poses of the whole arm, fast and slow"
    text = f"{count}: {listed}{more}; missing: {missing}"
    concerned = tuple(log.joint_names[j] for j in joints)
    numbers = {"identified": int((~weak).sum()), "base_parameters": len(weak)}
    return [log.finding("poor-excitation", text, concerned, **numbers)], log


def _sharpness(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> tuple[Array, tuple[str, ...], Array]:
    """Return the ratio of posterior to prior deviation for each base parameter, assuming 1 % torque noise."""
    robot = system.robot
    base = base_parameters(robot)
    columns = np.array(base.columns)
    with torch.no_grad():
        Y = regressor(robot, *log.tensors(rows, "q", "qd", "qdd"))[..., list(base.columns)].numpy()
    tau = np.sqrt((log.tau[rows] ** 2).mean(axis=0))
    noise = np.maximum(0.01 * tau, 1e-3 * tau.max()) + 1e-12
    A = (Y / noise[:, None]).reshape(-1, len(columns)) * inertial_spread(robot)[columns]
    # Neighbouring rows are redundant, so the log counts as one row per tenth of a second.
    looks = int(log.usable.sum()) * log.dt / LOOK if log.header.ordered else len(rows)
    gram = A.T @ A * (looks / len(rows))
    return np.sqrt(np.diag(np.linalg.inv(gram + np.eye(len(columns))))), base.names, columns


LARGEST = 1e3
SIZES = np.geomspace(1e-3, LARGEST, 200)
"""Fault sizes that are tried."""
SPAN = 1
"""Number of rows on either side for computing the torque rate; smaller than the margin in `explain`."""
EXPECTED = {
    "torque-delay": (0.02, 1.0, 1e3, "a delay of the torque", "{:.0f} ms"),
    "base-tilted": (3.0, 180.0, 1.0, "a tilt of the base", "{:.2g}°"),
    "masses-mismatch": (0.2, 1.0, 100.0, "errors of all masses", "{:.0f} %"),
    "heavier-link": (0.2, 10.0, 100.0, "a heavier link", "{:.0f} %"),
    "torque-gain": (0.5, 2.0, 100.0, "a wrong gain", "{:.0f} %"),
    "encoder-offset": (0.1, np.pi, 1.0, "an encoder offset", "{:.2g} {unit}"),
}
"""For each kind of fault, the size that a user expects to be detected and the largest size [s, degrees,
fraction, rad], the conversion factor to the unit of the message, its name, and the format of its size."""


@dataclass(frozen=True, eq=False)
class Fault:
    """A fault of unit size: its kind, its joint (if any), and the torque (n, nq) that the fault adds."""

    kind: str
    joint: str
    column: Array
    concerned: int


def check_visibility(explanation: Explanation) -> list[Finding]:
    """Report the size above which each fault is detected, and the force error that a typical fault causes."""
    faults, robot = list(_faults(explanation)), explanation.system.robot
    sizes = {fault: visible_size(explanation, fault) for fault in faults}
    units = {name: position_unit(robot, j) for j, name in enumerate(robot.joint_names)}
    texts, hidden = [], [f for f in faults if not f.joint or sizes[f] > EXPECTED[f.kind][0]]
    for kind, (expected, most, scale, what, words) in EXPECTED.items():
        alike, parts = [fault for fault in hidden if fault.kind == kind], []
        if not alike:
            continue
        for fault in (fault for fault in alike if sizes[fault] < most):
            size = words.format(scale * sizes[fault], unit=units.get(fault.joint))
            parts.append(f"{fault.joint} from {size}".strip())
        if never := [fault.joint or "all joints" for fault in alike if sizes[fault] >= most]:
            parts.append(f"never at {', '.join(never)}")
        force = max(force_of(explanation, fault) for fault in alike) * expected
        size = words.format(scale * expected, unit=units.get(alike[0].joint))
        changed = f" ({size}: force at the contact off by about {force:.2g} N)" if force else ""
        texts.append(f"{what}{': ' if alike[0].joint else ' '}{', '.join(parts)}{changed}")
    joints = tuple(dict.fromkeys(fault.joint for fault in hidden if fault.joint))
    evidence = {f"{fault.kind} {fault.joint}".strip(): size for fault, size in sizes.items()}
    text = f"smaller faults cannot be seen in this log: {'; '.join(texts)}"
    return [explanation.log.finding("faults-hidden", text, joints, **evidence)]


def force_of(explanation: Explanation, fault: Fault) -> float:
    """Return the RMS tip force [N] that a unit fault mimics after a fit, or 0 without enough contact."""
    problem = replace(explanation.problem, r=fault.column)
    J = problem.J[:, : problem.J.shape[1] - len(explanation.log.unmeasured)]
    touching = (J != 0.0).any(axis=(1, 2))
    if touching.sum() < LEAST_ROWS:
        return 0.0
    fit = cross_validate(problem, explanation.columns, explanation.prior)
    learned = explanation.columns @ fit.theta + problem.nuisance @ fit.nuisance
    # Least-squares solution of τ = Jᵀ F.
    inverse = np.linalg.pinv(J[touching].transpose(0, 2, 1))
    force = np.einsum("nkj,nj->nk", inverse, (fault.column - learned)[touching])
    return float(np.sqrt((force**2).sum(axis=1).mean()))


def visible_size(explanation: Explanation, fault: Fault) -> float:
    """Return the size above which a fault of either sign is detected, or `LARGEST` if there is none."""
    problem = explanation.problem
    rest = held_out(problem, explanation.columns, explanation.prior)
    added = held_out(replace(problem, r=fault.column), explanation.columns, explanation.prior)
    square, cross, added_square = (
        np.stack([product[rows].mean(axis=0) for rows in blocks_of(len(rest))])
        for product in (rest**2, rest * added, added**2)
    )

    def seen(size: float) -> bool:
        worse = square + 2.0 * size * cross + size**2 * added_square
        return significant(np.sqrt(square), np.sqrt(np.maximum(worse, 0.0)), fault.concerned)

    unseen = [size for size in SIZES if not (seen(size) and seen(-size))]
    return float(SIZES[max(unseen, default=0.0) < SIZES].min(initial=LARGEST))


def _faults(explanation: Explanation) -> Iterator[Fault]:
    system, log, rows = explanation.system, explanation.log, explanation.rows
    delays = []
    if log.header.ordered:  # unordered rows have no neighbours in time
        # Use the torque required by the motion, since the measured torque is noisier.
        ahead, behind = (residual(system, log, rows + k)[0] + log.tau[rows + k] for k in (SPAN, -SPAN))
        delays = [(ahead - behind) / (2.0 * SPAN * log.dt)]
        yield Fault("torque-delay", "", delays[0], log.nq)
    for j, joint in enumerate(log.joint_names):
        only = np.arange(log.nq) == j
        yield from (Fault("torque-delay", joint, delay * only, 1) for delay in delays)
        yield Fault("torque-gain", joint, log.tau[rows] * only, 1)
        column = encoder_hypothesis(system, log, rows, j).columns
        assert column is not None
        yield Fault("encoder-offset", joint, column[..., 0], 1)
    # Torque per degree of tilt about the horizontal axis for which the tilt is more visible.
    gravity, columns = system.robot.gravity.numpy(), robot_columns(system, log, rows, "gravity")[0]
    axes = np.linalg.svd(gravity[None])[2][1:] * np.linalg.norm(gravity) * np.pi / 180.0
    tilt = max((columns @ axis for axis in axes), key=lambda torque: float((torque**2).sum()))
    yield Fault("base-tilted", "", tilt, log.nq)
    links = robot_columns(system, log, rows, "masses")[0] * parameter_vector(system.robot).numpy()
    links = links.reshape(*links.shape[:2], log.nq, 10).sum(axis=-1)
    # The inertial parameters are assumed wrong by the same fraction, with signs that alternate along the arm.
    yield Fault("masses-mismatch", "", links @ -((-1.0) ** np.arange(log.nq)), log.nq)
    for j, joint in enumerate(log.joint_names):
        yield Fault("heavier-link", joint, links[..., j], log.nq)
