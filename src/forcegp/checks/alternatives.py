"""Hypotheses that explain a log as well as the accepted one, and tests that tell them apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from forcegp.checks.finding import Finding
from forcegp.checks.fit import Fit, gain_of
from forcegp.checks.hypotheses import Hypothesis
from forcegp.constraints import ConstrainedSystem

Tried = tuple[Hypothesis, Fit]
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
    system: ConstrainedSystem, chosen: Tried, tried: Iterable[Tried], null: Fit
) -> Iterator[Tried]:
    """The hypotheses that the held-out blocks cannot distinguish from the chosen one.

    The best comes first. Each lowers the error significantly, and by as much as the chosen one to within one
    standard error of the difference over blocks.
    """
    for hypothesis, fit in sorted(tried, key=lambda one: one[1].score.mean()):
        if _says_the_same(chosen[0], hypothesis):
            continue
        gain, error = gain_of(fit.score, null.score)
        loss, apart = gain_of(chosen[1].score, fit.score)
        if gain > ALONE * error and abs(loss) <= apart and _possible(system, hypothesis, fit):
            yield hypothesis, fit


def _says_the_same(chosen: Hypothesis, other: Hypothesis) -> bool:
    """Whether a hypothesis has the kind and joints of the chosen one, or contains it, as masses do a tool."""
    if (chosen.name, other.name) == ("payload", "masses"):
        return True
    return other.name == chosen.name and (not other.joints or bool({*other.joints} & {*chosen.joints}))


def _possible(system: ConstrainedSystem, hypothesis: Hypothesis, fit: Fit) -> bool:
    """Whether every link keeps a mass that is positive, or zero in the robot file; the fit does not enforce
    it."""
    if hypothesis.name != "masses":
        return True
    given = system.robot.mass.numpy()
    found = given + fit.theta[: 10 * system.robot.nq : 10]
    return bool(np.where(given > 0.0, found > 0.0, found >= -SMALL_MASS * given.sum()).all())


def with_alternatives(finding: Finding, others: Iterable[Finding]) -> Finding:
    """The finding with its alternatives, if there are any, and a test that tells them apart."""
    found: list[Finding] = []
    for other in others:
        alike = (f for f in (finding, *found) if f.kind == other.kind)
        if not any({*f.joints} & {*other.joints} or not other.joints for f in alike):
            found.append(other)
    if not found:
        return finding
    message = "; or ".join(one.message for one in (finding, *found))
    test = next(TESTS[kind] for kind in TESTS if kind in {finding.kind, *(f.kind for f in found)})
    return replace(finding, message=message, alternatives=tuple(found), told_apart_by=test)
