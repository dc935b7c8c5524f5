"""How large a fault must be to be seen in this log: the power of the tests of `explain`.

A fault of size θ adds θ φ to the unexplained torque r. The held-out residual is linear in it,
e(r + θ φ) = e(r) + θ e(φ), and contains what friction, offsets and the parameters accepted so far cannot
imitate. The fault is seen where `significant` accepts the rise of its size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from forcegp.checks.explain import Explanation, significant
from forcegp.checks.finding import Finding
from forcegp.checks.fit import BLOCKS, blocks_of, held_out
from forcegp.checks.hypotheses import encoder_hypothesis, robot_columns
from forcegp.checks.log import Log
from forcegp.checks.residual import residual, tensors
from forcegp.checks.statistics import Array
from forcegp.checks.units import position_unit
from forcegp.constraints import ConstrainedSystem
from forcegp.identification import parameter_vector, regressor

LARGEST = 1e3
"""Sizes beyond this are not looked for."""
MOST = {"encoder-offset": np.pi, "base-tilted": 180.0}
"""Largest sizes that faults can have: half a turn, in rad and degrees."""
SIZES = np.geomspace(1e-3, LARGEST, 200)
"""Sizes that are tried."""
SPAN = 1
"""Rows on either side of which the rate of the torque is taken; fewer than the margin of `explain`."""
WORTH = {
    "torque-gain": 0.5,
    "encoder-offset": 0.1,
    "base-tilted": 6.0,
    "torque-delay": 0.04,
    "masses-mismatch": 0.5,
}
"""Sizes that a user expects a check to see: share, rad, degrees, s, share of a link's inertial parameters."""
UNITS = {
    "torque-gain": "a gain of {joint} wrong by less than {size:.0%}",
    "encoder-offset": "an encoder offset of {joint} under {size:.2g} {unit}",
    "base-tilted": "a base tilted by less than {size:.2g}°",
    "torque-delay": "a torque delay under {size:.2g} s",
    "masses-mismatch": "masses wrong by less than {size:.0%}",
}
NEVER = {
    "torque-gain": "any wrong gain of {joint}",
    "encoder-offset": "any encoder offset of {joint}",
    "base-tilted": "any tilt of the base",
    "torque-delay": "any torque delay",
    "masses-mismatch": "any error of the masses",
}


@dataclass(frozen=True)
class Fault:
    """A fault of unit size: its kind, its joint, if it has one, and the torque `(n, nq)` that it adds."""

    kind: str
    joint: str
    column: Array
    concerned: int


def check_visibility(system: ConstrainedSystem, told: Explanation) -> list[Finding]:
    """A note on the faults that would stay unseen in this log."""
    sizes = {
        (fault.kind, fault.joint): visible_size(told, fault) for fault in _faults(system, told.log, told.rows)
    }
    hidden = {key: size for key, size in sizes.items() if size > WORTH[key[0]]}
    if not hidden:
        return []
    robot = system.robot
    units = {name: position_unit(robot, j) for j, name in enumerate(robot.joint_names)}
    texts = [
        NEVER[kind].format(joint=joint)
        if size >= MOST.get(kind, LARGEST)
        else UNITS[kind].format(joint=joint, size=size, unit=units.get(joint))
        for (kind, joint), size in hidden.items()
    ]
    more = f" and {len(texts) - 5} more" if len(texts) > 5 else ""
    text = f"this log does not show {'; '.join(texts[:5])}{more}"
    joints = tuple(dict.fromkeys(joint for _, joint in hidden if joint))
    evidence = {f"{kind} {joint}".strip(): size for (kind, joint), size in sizes.items()}
    return [Finding("faults-hidden", text, told.log.all_rows, joints, evidence=evidence)]


def visible_size(told: Explanation, fault: Fault) -> float:
    """Size from which on the torque shows a fault of either sign, or `LARGEST`."""
    problem = told.problem
    rest = held_out(problem, told.columns, told.prior)
    added = held_out(replace(problem, r=fault.column), told.columns, told.prior)
    block = blocks_of(len(rest))
    own, cross, other = (
        np.stack([product[block == k].mean(axis=0) for k in range(BLOCKS)])
        for product in (rest**2, rest * added, added**2)
    )

    def seen(size: float) -> bool:
        worse = own + 2.0 * size * cross + size**2 * other
        return significant(np.sqrt(own), np.sqrt(np.maximum(worse, 0.0)), fault.concerned)

    unseen = [size for size in SIZES if not (seen(size) and seen(-size))]
    return float(SIZES[max(unseen, default=0.0) < SIZES].min(initial=LARGEST))


def _faults(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Iterator[Fault]:
    for j, joint in enumerate(log.joint_names):
        only = np.arange(log.nq) == j
        yield Fault("torque-gain", joint, log.tau[rows] * only, 1)
        column = encoder_hypothesis(system, log, rows, j).columns
        assert column is not None
        yield Fault("encoder-offset", joint, column[..., 0], 1)
    if log.header.ordered:  # rows in order of selection have no neighbours in time
        yield Fault("torque-delay", "", _rate(system, log, rows), log.nq)
    yield Fault("base-tilted", "", _tilt(system, log, rows), log.nq)
    yield Fault("masses-mismatch", "", _masses(system, log, rows), log.nq)


def _rate(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Array:
    """`(n, nq)` rate of change of the torque that the motion needs; the measured one has more noise."""
    ahead, behind = (residual(system, log, rows + k).r + log.tau[rows + k] for k in (SPAN, -SPAN))
    return (ahead - behind) / (2.0 * SPAN * log.dt)


def _tilt(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Array:
    """Torque per degree of a tilt, about the horizontal axis that shows it better."""
    columns = robot_columns(system, log, rows, "gravity")[0]
    gravity = system.robot.gravity.numpy()
    axes = np.linalg.svd(gravity[None])[2][1:] * np.linalg.norm(gravity) * np.pi / 180.0
    torques = [columns @ axis for axis in axes]
    return max(torques, key=lambda torque: float((torque**2).sum()))


def _masses(system: ConstrainedSystem, log: Log, rows: np.ndarray) -> Array:
    """Torque of all inertial parameters of every other link, which are taken as wrong by the same share."""
    robot = system.robot
    with torch.no_grad():
        Y = regressor(robot, *tensors(log, rows, "q", "qd", "qdd")).numpy()
    parameters = parameter_vector(robot).numpy()
    sign = np.repeat((-1.0) ** np.arange(robot.nq), 10)
    return Y @ (sign * parameters)
