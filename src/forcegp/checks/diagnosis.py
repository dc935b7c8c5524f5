"""From an accepted hypothesis to a finding in words, and to the log without the fault."""

from __future__ import annotations

import numpy as np

from forcegp.checks.finding import Finding
from forcegp.checks.fit import Fit
from forcegp.checks.hypotheses import Hypothesis
from forcegp.checks.log import Log
from forcegp.checks.statistics import Array
from forcegp.checks.units import displacement
from forcegp.constraints import ConstrainedSystem

CURRENT = 1.6
"""Gains of all joints beyond this factor are no calibration error: another quantity was logged."""
TILT = 30.0
"""Largest angle at which a base counts as tilted, not as mounted another way round [degrees]."""
WEIGHTLESS = 0.3
"""Share of gravity below which the torque holds none of it."""
SIGNIFICANT = 3.0
"""Standard errors from which a parameter of a tool counts."""


SMALL_ANGLE = np.radians(0.5)
"""Encoder offsets below this are within calibration, or an error of a centre of mass [rad]."""
SMALL_GAIN = 0.2
"""Gains closer to 1 than this may as well be errors of the masses of a robot file."""
EXPLAINED = 0.5
"""Share of the torque that a gain may leave unexplained, as any useful model may."""
SMALL_TILT = 1.0
"""Bases are levelled to better than this [degrees]."""
SMALL_GRAVITY = 0.05
"""Share of gravity below which a change of its size is an error of the masses."""


def plausible(system: ConstrainedSystem, hypothesis: Hypothesis, fit: Fit) -> bool:
    """Whether the parameters are what a hypothesis says: a tool has a mass, an offset is not a trifle."""
    if hypothesis.name == "encoder-offset":
        return bool(abs(fit.theta[0]) > max(SMALL_ANGLE, SIGNIFICANT * fit.spread[0]))
    if hypothesis.name == "gains":
        joints = list(hypothesis.joints)
        # A gain that only makes the torque larger than its error explains nothing.
        explained = float(np.median(fit.relative[joints])) < EXPLAINED
        return explained and bool((np.abs(fit.theta[: len(joints)]) > SMALL_GAIN).any())
    if hypothesis.name == "gravity":
        assumed = system.robot.gravity.numpy()
        angle, size = _turn(assumed, assumed + fit.theta[:3])
        return angle > SMALL_TILT or abs(size - 1.0) > SMALL_GRAVITY
    if hypothesis.name == "payload":
        return bool(fit.theta[0] > SIGNIFICANT * fit.spread[0])
    return True


def corrected(log: Log, hypothesis: Hypothesis, theta: Array) -> Log:
    """The log without the fault; unchanged where the robot is at fault."""
    joints = list(hypothesis.joints)
    if hypothesis.name == "gains":
        tau = log.tau.copy()
        # r = u − τ = g τ: the right torque is (1 + g) τ.
        tau[:, joints] *= 1.0 + theta[: len(joints)]
        return log.replace(tau=tau)
    if hypothesis.name == "encoder-offset":
        q = log.q.copy()
        q[:, joints] += theta[:1]
        return log.replace(q=q)
    return hypothesis.change(log)


def finding_of(
    system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: Fit, alike: tuple[int, ...] = ()
) -> Finding:
    """The finding that a hypothesis stands for; `alike` are the joints of those that explain the same."""
    names = tuple(log.joint_names[j] for j in hypothesis.joints)
    listed = "all joints" if len(names) == log.nq > 1 else " and ".join(names)
    if hypothesis.name == "joint-sign" and len(alike) > 1:
        names = tuple(log.joint_names[j] for j in alike)
        listed = " or ".join(names)
    texts = {
        "torque-sign": f"the torque of {listed} fits the motion with the opposite sign",
        "joint-sign": f"{listed} fits the robot file when it turns the other way",
        "torque-order": f"the torques of {listed} fit when exchanged",
        "joint-order": f"{listed} fit the robot file when exchanged",
    }
    if hypothesis.name in texts:
        return Finding(hypothesis.name, texts[hypothesis.name], log.all_rows, names)
    return _PARAMETRIC[hypothesis.name](system, log, hypothesis, fit)


def _delay(system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: Fit) -> Finding:
    seconds = abs(hypothesis.shift) * log.dt
    word = "after" if hypothesis.shift > 0 else "before"
    text = (
        f"the torque is logged about {1e3 * seconds:.3g} ms ({abs(hypothesis.shift)} rows) {word} the motion"
    )
    return Finding(
        "torque-delay", text, log.all_rows, evidence={"rows": hypothesis.shift, "seconds": seconds}
    )


def _gains(system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: Fit) -> Finding:
    gains = 1.0 + fit.theta[: len(hypothesis.joints)]
    names = tuple(log.joint_names[j] for j in hypothesis.joints)
    evidence = {f"factor {name}": gain for name, gain in zip(names, gains, strict=True)}
    listed = ", ".join(f"{name} {gain:.3g}" for name, gain in zip(names, gains, strict=True))
    negative = tuple(name for name, gain in zip(names, gains, strict=True) if gain < 0.0)
    if negative:
        text = f"torques fit when multiplied by {listed}: the sign is wrong"
        return Finding("torque-sign", text, log.all_rows, negative, evidence=evidence)
    factor = np.exp(np.abs(np.log(np.abs(gains) + 1e-12)))
    if 2 * len(names) > log.nq > 1 and np.median(factor) > CURRENT:
        text = f"torques fit when multiplied by {listed}: currents, or torques on the motor side"
        return Finding("torque-current", text, log.all_rows, names, evidence=evidence)
    off = [k for k in range(len(names)) if factor[k] > 1.05]
    text = f"torques fit when multiplied by {listed}"
    return Finding(
        "torque-gain", text, log.all_rows, tuple(names[k] for k in off) or names, evidence=evidence
    )


def _encoder(system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: Fit) -> Finding:
    name, offset = log.joint_names[hypothesis.joints[0]], float(fit.theta[0])
    added = displacement(system.robot, hypothesis.joints[0], offset)
    text = f"{name} fits with {added} added to its position, ± {fit.spread[0]:.4f}"
    return Finding("encoder-offset", text, log.all_rows, (name,), evidence={"add_rad": offset})


def _gravity(system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: Fit) -> Finding:
    assumed = system.robot.gravity.numpy()
    found = assumed + fit.theta[:3]
    given = float(np.linalg.norm(assumed))
    angle, size = _turn(assumed, found)
    evidence = {"angle_deg": angle, **{f"g{axis}": value for axis, value in zip("xyz", found, strict=True)}}
    vector = ", ".join(f"{value:.3g}" for value in found)
    if given > 0.0 and size < WEIGHTLESS:
        text = "the torque contains no gravity: gravity compensation was subtracted"
        return Finding("torque-without-gravity", text, log.all_rows, log.joint_names, evidence=evidence)
    tilted = given > 0.0 and angle <= TILT
    text = f"the torque fits with gravity ({vector}) m/s², {angle:.3g}° from the scene's"
    return Finding("base-tilted" if tilted else "gravity-direction", text, log.all_rows, evidence=evidence)


def _turn(assumed: Array, found: Array) -> tuple[float, float]:
    """Angle between two vectors in degrees, and the length of the second over that of the first."""
    lengths = float(np.linalg.norm(assumed)), float(np.linalg.norm(found))
    cosine = found @ assumed / max(lengths[0] * lengths[1], 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), lengths[1] / max(lengths[0], 1e-12)


def _payload(system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: Fit) -> Finding:
    mass = float(fit.theta[0])
    text = f"the torque fits with {mass:.3g} ± {fit.spread[0]:.2g} kg more on the last link"
    evidence = {"mass_kg": mass, "spread_kg": fit.spread[0]}
    return Finding("payload-missing", text, log.all_rows, (log.joint_names[-1],), evidence=evidence)


def _masses(system: ConstrainedSystem, log: Log, hypothesis: Hypothesis, fit: Fit) -> Finding:
    text = "the torque fits better with other masses and centres of mass than those of the robot file"
    worst = int(np.argmax(np.abs(fit.theta[: 10 * log.nq].reshape(log.nq, 10)[:, 0])))
    evidence = {"largest_mass_change_kg": fit.theta[10 * worst]}
    return Finding("masses-mismatch", text, log.all_rows, (log.joint_names[worst],), evidence=evidence)


_PARAMETRIC = {
    "torque-delay": _delay,
    "gains": _gains,
    "encoder-offset": _encoder,
    "gravity": _gravity,
    "payload": _payload,
    "masses": _masses,
}
