"""Hypotheses about faults of a log or a robot file, the resulting findings, and the correction of logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
import torch

from forcegp import dynamics, kinematics
from forcegp.checks.contact import tip_path
from forcegp.checks.finding import Finding
from forcegp.checks.fit import TorqueFit, TorqueProblem, labelled_contacts, residual, takes_friction_out
from forcegp.checks.log import Array, Log, displacement, force_unit
from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.identification import MASS_SHARE, MOMENT_ARM, regressor
from forcegp.logs.compensated import subtracted
from forcegp.logs.mapping import Compensated
from forcegp.robot.model import RobotModel

LAGS = (1, 2, 3, 4, 6, 8, 11, 15, 20)
"""Delays between torque and motion to be tried, in samples, in either direction."""
TOOL_MASS = 5.0
"""Prior standard deviation of the mass of a tool that is missing from the robot file [kg]."""
RISES = (0.3, 2.0, 10.0)
"""Factors by which the slope of dry friction near rest may differ from the declared slope. The shape is
rarely known, and friction in MuJoCo rises more gently."""
SLOW, GRAVITY, LARGEST_DRIFT = 0.01, 10.0, 100.0
"""Sliding speed below which dry friction at contacts is smoothed [m/s]; possible error in gravity [m/s²];
possible drift of a torque sensor [N m, N]."""
ROBOT = ("gravity", "payload", "masses")
"""Hypotheses about the robot file. These do not change the log."""
CHANGE, MOST_CHANGES = "payload-change", 8
"""Hypothesis about a payload that is not that of the whole log; maximum number of times at which trajectories
begin for which it is tried, since each is cross-validated."""


@dataclass(frozen=True)
class Hypothesis:
    """A possible explanation of the torque, named after a kind of finding or a group of kinds.

    `change` corrects the log under this hypothesis, except for the effects of its parameters. `size` is the
    number of parameters, not counting discrete choices. `columns` (n, nq, p) are the torques added to r per
    unit of each parameter, and `prior` (p,) contains their prior standard deviations. `instruments` have the
    shape of `columns` and allow for errors in them. `shift` is a delay of the torque in samples. `first` is
    the row from which the columns apply.
    """

    name: str
    size: int
    change: Callable[[Log], Log]
    columns: Array | None = None
    prior: Array | None = None
    joints: tuple[int, ...] = ()
    shift: int = 0
    instruments: Array | None = None
    first: int = 0


def problem_of(
    system: ConstrainedSystem, log: Log, rows: np.ndarray, scale: Array | None = None
) -> TorqueProblem:
    """Return the torque problem for the given rows. Viscous and dry friction and an offset are nuisances."""
    qd = log.qd[rows]
    laws = qd, np.tanh(qd / system.robot.friction_velocity.numpy()), np.ones_like(qd)
    nuisance = np.concatenate([_diagonal(x) for x in laws], axis=-1)
    size = np.sqrt((log.tau[rows] ** 2).mean(axis=0))
    size = np.maximum(size, 1e-3 * size.max())
    return TorqueProblem(*residual(system, log, rows), nuisance, size, size if scale is None else scale)


def other_rise_columns(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Array:
    """Return columns (n, nq, p) for the declared Coulomb friction with a different slope near rest."""
    declared = np.tile(system.robot.friction.numpy() > 0.0, len(RISES))
    return shape_columns(system, log, rows)[..., : len(declared)][..., declared]


def shape_columns(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Array:
    """Return columns (n, nq, p) for alternative shapes of dry friction and for quadratic friction."""
    x, qd = log.qd[rows] / system.robot.friction_velocity.numpy(), log.qd[rows]
    shapes = *(np.tanh(k * x) - np.tanh(x) for k in RISES), qd * np.abs(qd)
    return np.concatenate([_diagonal(shape) for shape in shapes], axis=-1)


def contact_friction_columns(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Array:
    """Return friction columns Jᵀv and Jᵀv/|v| (n, nq, p) for each contact that slides at velocity v."""
    (q,), columns = log.tensors(rows, "q"), [np.zeros((len(rows), log.nq, 0))]
    for contact in [] if takes_friction_out(system, log) else labelled_contacts(system, log):
        if isinstance(contact, SurfaceContact):
            v = tip_path(system, contact, log, rows).along * log.contact[contact.name][rows][:, None]
            J = kinematics.point_jacobian(system.robot, q, contact.frame, contact.point).detach().numpy()
            speed = np.sqrt((v**2).sum(axis=1, keepdims=True) + SLOW**2)
            columns.append(np.stack([np.einsum("nkj,nk->nj", J, f) for f in (v, v / speed)], axis=-1))
    return np.concatenate(columns, axis=-1)


def _diagonal(x: Array) -> Array:
    """Return matrices (n, nq, nq) with x on the diagonal."""
    return x[..., None] * np.eye(x.shape[-1])


def unchanged(log: Log) -> Log:
    """Return the log unchanged."""
    return log


def delayed(log: Log, shift: int, joints: tuple[int, ...] = ()) -> Log:
    """Replace the torques of the given (or all) joints by those `shift` rows later, and mask the ends."""
    tau, lost = log.tau.copy(), np.ones(len(log), bool)
    columns = list(joints) or list(range(log.nq))
    for s in log.stretches:
        rows = np.arange(max(s.start, s.start - shift), min(s.stop, s.stop - shift))
        tau[np.ix_(rows, columns)] = log.tau[np.ix_(rows + shift, columns)]
        lost[rows] = False
    return log.replace(tau=tau).mask(lost)


def restored(log: Log, robot: RobotModel, compensated: Compensated) -> Log:
    """Return the log with the torque that a driver has subtracted."""
    return log.replace(tau=log.tau + subtracted(robot, compensated, log.q, log.qd, log.qdd))


def discrete(system: ConstrainedSystem, log: Log) -> Iterator[Hypothesis]:
    """Yield hypotheses without parameters: wrong signs, swapped joints, and torques less those of a model."""
    every, tau, motion = tuple(range(log.nq)), ("tau",), ("q", "qd", "qdd")
    for what in ("gravity", "model") if system.robot.gravity.any() else ("model",):
        change = partial(restored, robot=system.robot, compensated=what)
        yield Hypothesis(f"torque-without-{what}", 0, change, joints=every)
    if log.nq > 1:
        yield Hypothesis("torque-sign", 0, partial(Log.changed, names=tau, flip=every), joints=every)
    for j in every:
        for name, names in (("torque-sign", tau), ("joint-sign", motion + tau), ("joint-sign", motion)):
            yield Hypothesis(name, 0, partial(Log.changed, names=names, flip=(j,)), joints=(j,))
    for pair in combinations(every, 2):
        for name, names in (("torque-order", tau), ("joint-order", motion + tau)):
            yield Hypothesis(name, 0, partial(Log.changed, names=names, order=pair), joints=pair)


def continuous(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Iterator[Hypothesis]:
    """Yield the hypotheses with parameters: gains, encoder offsets, gravity, a payload and masses."""
    for j in range(log.nq):
        yield gain_hypothesis(log, rows, (j,))
        yield encoder_hypothesis(system, log, rows, j)
        yield drift_hypothesis(log, rows, j)
    yield from robot_hypotheses(system, log, rows)


def gain_hypothesis(log: Log, rows: np.ndarray, joints: tuple[int, ...]) -> Hypothesis:
    """Return the hypothesis that the torques of the given joints must be scaled: u − τ = g τ."""
    columns = _diagonal(log.tau[rows])[..., list(joints)]
    return Hypothesis("gains", len(joints), unchanged, columns, np.full(len(joints), 100.0), joints)


def common_gain_hypothesis(log: Log, rows: np.ndarray, problem: TorqueProblem) -> Hypothesis:
    """Return the hypothesis of one factor for all torques, with the required torque as the instrument."""
    every, needed = tuple(range(log.nq)), (problem.r + log.tau[rows])[..., None]
    columns = log.tau[rows][..., None]
    return Hypothesis("common-gain", 1, unchanged, columns, np.full(1, 100.0), every, instruments=needed)


def drift_hypothesis(log: Log, rows: np.ndarray, j: int) -> Hypothesis:
    """Return the hypothesis that the torque of joint j drifts over the log: u − τ = −θ s with |s| ≤ 1/2."""
    columns = -_elapsed(log)[rows, None, None] * np.eye(log.nq)[:, [j]]
    return Hypothesis("drift", 1, unchanged, columns, np.full(1, LARGEST_DRIFT), (j,))


def _elapsed(log: Log) -> Array:
    """Return the time from the middle of the log as a fraction of its duration `(n,)`."""
    t = log.t[log.usable]
    return (log.t - 0.5 * (t.min() + t.max())) / max(np.ptp(t), 1e-12)


def current_hypothesis(
    log: Log, rows: np.ndarray, problem: TorqueProblem, joints: tuple[int, ...]
) -> Hypothesis:
    """Return a gain hypothesis whose instrument is the required torque, which is free of torque noise."""
    needed = _diagonal(problem.r + log.tau[rows])[..., list(joints)]
    return replace(gain_hypothesis(log, rows, joints), instruments=needed)


def robot_hypotheses(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Iterator[Hypothesis]:
    """Yield the hypotheses about the robot file."""
    for name in ROBOT:
        columns, prior = robot_columns(system, log, rows, name)
        yield Hypothesis(name, columns.shape[-1], unchanged, columns, prior)
    starts = np.flatnonzero(np.diff(log.segment)) + 1
    for first in starts.tolist() if len(starts) <= MOST_CHANGES else ():
        columns, prior = robot_columns(system, log, rows, CHANGE, first)
        yield Hypothesis(CHANGE, columns.shape[-1], unchanged, columns, prior, first=first)


def robot_columns(
    system: ConstrainedSystem, log: Log, rows: np.ndarray, name: str, first: int = 0
) -> tuple[Array, Array]:
    """Return the torque (n, nq, p) per unit of each uncertain parameter, and the tolerances (p,).

    Before row `first`, the torque is zero.
    """
    robot = system.robot
    q, qd, qdd = log.tensors(rows, "q", "qd", "qdd")
    with torch.no_grad():
        if name == "gravity":  # r = Q_G(δ) for gravity off by δ
            axes = torch.eye(3, dtype=q.dtype)
            columns = [dynamics.gravity_force(replace(robot, gravity=axis), q) for axis in axes]
            return torch.stack(columns, dim=-1).numpy(), np.full(3, GRAVITY)
        Y = regressor(robot, q, qd, qdd).numpy()
    # r = Y π₀ − τ = −Y δ for parameters that are off by δ.
    if name in ("payload", CHANGE):
        return -Y[..., -10:] * (rows >= first)[:, None, None], TOOL_MASS * np.repeat(
            [1.0, MOMENT_ARM, MOMENT_ARM**2], (1, 3, 6)
        )
    return -Y, inertial_spread(robot)


def inertial_spread(robot: RobotModel) -> Array:
    """Return the tolerances (10 nq,) of the inertial parameters in a robot file."""
    mass = robot.mass.numpy()[:, None]
    share = np.repeat([MASS_SHARE, MOMENT_ARM, MOMENT_ARM**2], (1, 3, 6))
    return (np.maximum(mass, 0.01 * mass.max()) * share).ravel()


def encoder_hypothesis(system: ConstrainedSystem, log: Log, rows: np.ndarray, j: int) -> Hypothesis:
    """Return the hypothesis that the encoder of joint j has an offset δ, so that r = u(q) − τ = −∂u/∂q δ."""
    q, qd, qdd = log.tensors(rows, "q", "qd", "qdd")
    step = 1e-4 * torch.eye(log.nq, dtype=q.dtype)[j]
    with torch.no_grad():
        ahead, behind = (dynamics.inverse_dynamics(system.robot, q + s, qd, qdd) for s in (step, -step))
    columns = ((behind - ahead) / 2e-4).numpy()[..., None]
    return Hypothesis("encoder-offset", 1, unchanged, columns, np.full(1, 1.0), (j,))


CURRENT = 1.6
"""Median gain factor above which a different quantity must have been logged instead of the torque."""
TILT = 30.0
"""Largest angle that counts as a tilt of the base; a larger one is a different mounting [degrees]."""
WEIGHTLESS, PARAMETER_Z = 0.3, 3.0
"""Fraction of gravity below which torques lack it; standard errors at which payload and offsets count."""
SMALL_ANGLE, LARGEST_ANGLE = np.radians(0.5), 1.0
"""Encoder offset below which calibration or the centres of mass may be the cause; offset above which a
linearisation cannot determine the offset [rad, m]."""
SMALL_GAIN, EXPLAINED = 0.2, 0.5
"""Deviation of a gain from 1 that wrong masses may cause; accepted fraction of unexplained torque."""
SMALL_COMMON_GAIN, KNOWN_GAIN = 0.05, 2.0
"""Deviation from 1 of the gain of all torques that is reported, and its least size in standard errors. It is
tried only in place of offsets that are significant already. Torques × 0.9 of a UR5 give 2.3, × 0.8 4.2."""
SMALL_TILT, EARTH = 1.0, 9.81
"""Tilt that wrong masses may cause [degrees]; magnitude assumed if the scene has no gravity [m/s²]."""
SAME_GRAVITY = 0.2, 0.5
"""Accepted relative errors in the size of gravity due to wrong masses, for tilts and for larger angles."""
DISCRETE = {
    "torque-sign": "the torque of {} fits the motion with the opposite sign",
    "joint-sign": "{} fits the robot file when it turns the other way",
    "torque-order": "the torques of {} fit when exchanged",
    "joint-order": "{} fit the robot file when exchanged",
    "torque-without-gravity": "the torque of {} contains no gravity: the driver subtracts it",
    "torque-without-model": "the torque of {} contains no inverse dynamics: the driver subtracts a model",
}


def plausible(system: ConstrainedSystem, hypothesis: Hypothesis, fit: TorqueFit) -> bool:
    """Return whether the parameters are physically plausible. For example, tool mass must be positive."""
    if hypothesis.name == "encoder-offset":
        least = max(SMALL_ANGLE, PARAMETER_Z * fit.spread[0])
        return bool(least < abs(fit.theta[0]) <= LARGEST_ANGLE)
    if hypothesis.name == "torque-without-model":
        # Wrong accelerations would fit better without a model too, so friction must explain each joint.
        return bool(np.median(fit.shares, axis=0).max() < EXPLAINED)
    if hypothesis.name == "gains":
        joints = list(hypothesis.joints)
        # A gain that only makes the torque larger than its error explains nothing.
        explained = float(np.median(np.median(fit.shares[:, joints], axis=0))) < EXPLAINED
        size, spread = (np.abs(x[: len(joints)]) for x in (fit.theta, fit.spread))
        return explained and bool((size > np.maximum(SMALL_GAIN, spread)).any())
    if hypothesis.name == "common-gain":
        least = max(SMALL_COMMON_GAIN, KNOWN_GAIN * fit.spread[0])
        return bool(least < abs(fit.theta[0]) and fit.theta[0] > -1.0)
    if hypothesis.name == "gravity":
        angle, size = _turn(system.robot, fit.theta[:3])
        # No place on earth has another size of gravity: such a fit has masses or gains that are wrong.
        same = abs(size - 1.0) <= SAME_GRAVITY[angle > TILT]
        return bool(size < WEIGHTLESS) or (angle > SMALL_TILT and same)
    if hypothesis.name == "drift":
        return bool(abs(fit.theta[0]) > PARAMETER_Z * fit.spread[0])
    if hypothesis.name == CHANGE:
        return bool(abs(fit.theta[0]) > PARAMETER_Z * fit.spread[0])
    if hypothesis.name == "payload":
        known = abs(fit.theta[0]) > PARAMETER_Z * fit.spread[0]
        return bool(known and fit.theta[0] > -float(system.robot.mass[-1]))
    return True


def corrected(log: Log, hypothesis: Hypothesis, theta: Array) -> Log:
    """Return the log with the fault corrected, or the same log if the fault is in the robot file."""
    concerned = np.isin(np.arange(log.nq), hypothesis.joints)
    if hypothesis.name == "gains":  # r = u − τ = g τ: the right torque is (1 + g) τ
        factor = np.ones(log.nq)
        factor[list(hypothesis.joints)] += theta[: len(hypothesis.joints)]
        return log.replace(tau=log.tau * factor)
    if hypothesis.name == "common-gain":
        return log.replace(tau=log.tau * (1.0 + theta[0]))
    if hypothesis.name == "drift":
        return log.replace(tau=log.tau - theta[0] * _elapsed(log)[:, None] * concerned)
    if hypothesis.name == "encoder-offset":
        return log.replace(q=log.q + theta[0] * concerned)
    return hypothesis.change(log)


def finding_of(
    system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: TorqueFit, alike: tuple[int, ...] = ()
) -> Finding:
    """Return the finding for a hypothesis. `alike` contains the joints of equivalent hypotheses."""
    name, theta, spread, evidence = hypothesis.name, fit.theta, fit.spread, dict[str, float]()
    one_of = name == "joint-sign" and len(alike) > 1
    names = tuple(log.joint_names[j] for j in (alike if one_of else hypothesis.joints))
    every = len(names) == log.nq > 1 and not one_of
    listed = "all joints" if every else (" or " if one_of else " and ").join(names)
    if name == "gains":
        return _gains(log, names, 1.0 + theta[: len(names)])
    if name == "gravity":
        return _gravity(system, log, theta[:3])
    if name == "common-gain":
        text = f"all torques fit when multiplied by {1.0 + theta[0]:.3g} ± {spread[0]:.2g}"
        return log.finding("torque-gain", text, names, factor=1.0 + theta[0])
    if name in DISCRETE:
        text = DISCRETE[name].format(listed)
    elif name == "torque-delay":
        rows, seconds = abs(hypothesis.shift), abs(hypothesis.shift) * log.dt
        about = "about" if rows < LAGS[-1] else "at least"
        word = "after" if hypothesis.shift > 0 else "before"
        which = f" of {listed}" if hypothesis.joints else ""
        text = f"the torque{which} is logged {about} {1e3 * seconds:.3g} ms ({rows} rows) {word} the motion"
        evidence = {"rows": hypothesis.shift, "seconds": seconds}
    elif name == "encoder-offset":
        added = displacement(system.robot, hypothesis.joints[0], float(theta[0]))
        text = f"{listed} fits with {added} added to its position, ± {spread[0]:.4f}"
        evidence = {"add_rad": float(theta[0])}
    elif name == "drift":
        unit = force_unit(system.robot, hypothesis.joints[0])
        name = "torque-offset"
        text = f"the logged torque of {listed} drifts by {theta[0]:+.3g} ± {spread[0]:.2g} {unit}"
        evidence = {f"drift {listed}": theta[0], "largest_torque": 0.5 * abs(theta[0])}
    elif name in ("payload", CHANGE):
        names, more = (log.joint_names[-1],), "more" if theta[0] > 0.0 else "less"
        text = f"the torque fits with {abs(theta[0]):.3g} ± {spread[0]:.2g} kg {more} on the last link"
        evidence = {"mass_kg": float(theta[0]), "spread_kg": spread[0]}
        if name == CHANGE:
            text, whole = f"{text} from row {hypothesis.first} on", ((hypothesis.first, len(log)),)
            return Finding("payload-missing", text, whole, names, evidence=evidence)
        name = "payload-missing"
    else:
        text = "the torque fits better with other masses and centres of mass than those of the robot file"
        worst = int(np.argmax(np.abs(theta[: 10 * log.nq : 10])))
        name, names = "masses-mismatch", (log.joint_names[worst],)
        evidence = {"largest_mass_change_kg": theta[10 * worst]}
    return log.finding(name, text, names, **evidence)


def _gains(log: Log, names: tuple[str, ...], gains: Array) -> Finding:
    """Return the finding on torques that must be scaled: a wrong sign, a current, or a wrong gain."""
    evidence = {f"factor {name}": gain for name, gain in zip(names, gains, strict=True)}
    listed = ", ".join(f"{name} {gain:.3g}" for name, gain in zip(names, gains, strict=True))
    text = f"torques fit when multiplied by {listed}"
    factor = np.exp(np.abs(np.log(np.abs(gains) + 1e-12)))
    kind, among = "torque-gain", factor > 1.05
    if (gains < 0.0).any():
        kind, among, text = "torque-sign", gains < 0.0, f"{text}: the sign is wrong"
    elif 2 * len(names) > log.nq > 1 and np.median(factor) > CURRENT:
        kind, among, text = "torque-current", gains > 0.0, f"{text}: currents, or torques on the motor side"
    if kind == "torque-gain" and log.header.torque_scale_std is not None:
        text = f"{text}; a fit learns scales of currents itself"
    joints = tuple(name for name, hit in zip(names, among, strict=True) if hit) or names
    return log.finding(kind, text, joints, **evidence)


def _gravity(system: ConstrainedSystem, log: Log, change: Array) -> Finding:
    """Return the finding that gravity is missing in the torque, or has a different direction there."""
    fitted = system.robot.gravity.numpy() + change
    angle, size = _turn(system.robot, change)
    evidence = {"angle_deg": angle, **{f"g{axis}": value for axis, value in zip("xyz", fitted, strict=True)}}
    vector = ", ".join(f"{value:.3g}" for value in fitted)
    pulls = bool(system.robot.gravity.any())
    if pulls and size < WEIGHTLESS:
        text = DISCRETE["torque-without-gravity"].format("all joints")
        return log.finding("torque-without-gravity", text, log.joint_names, **evidence)
    tilted = pulls and angle <= TILT
    text = f"the torque fits with gravity ({vector}) m/s², {angle:.3g}° from the scene's"
    return log.finding("base-tilted" if tilted else "gravity-direction", text, **evidence)


def is_tilt(system: ConstrainedSystem, hypothesis: Hypothesis, fit: TorqueFit) -> bool:
    """Return whether a hypothesis rotates gravity by a small angle."""
    if hypothesis.name != "gravity" or not system.robot.gravity.any():
        return False
    angle, size = _turn(system.robot, fit.theta[:3])
    return angle <= TILT and size >= WEIGHTLESS


def _turn(robot: RobotModel, change: Array) -> tuple[float, float]:
    """Return the angle [°] by which a change turns gravity, and the ratio of its new length to the old."""
    assumed = robot.gravity.numpy()
    fitted = assumed + change
    lengths = float(np.linalg.norm(assumed)), float(np.linalg.norm(fitted))
    cosine = fitted @ assumed / max(lengths[0] * lengths[1], 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), lengths[1] / (lengths[0] or EARTH)
