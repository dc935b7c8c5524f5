"""Hypotheses that explain a log as well as the one that was chosen, and what would tell them apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from forcegp.checks.finding import Finding
from forcegp.checks.fit import Fit, gain_of
from forcegp.checks.hypotheses import Hypothesis
from forcegp.constraints import ConstrainedSystem

Tried = tuple[Hypothesis, Fit]
ALONE = 2.0
"""Standard errors by which an alternative lowers the held-out error on its own: as something is known to be
wrong, chance in 4 % of cases will do (Student's t, seven degrees of freedom)."""
TESTS = {
    "torque-gain": "hang a known weight from the tip: its torque shows the gain, whatever the masses",
    "torque-current": "hang a known weight from the tip: its torque shows the gains, whatever the masses",
    "torque-sign": "push the joint at rest by hand: the torque that holds it shows its sign",
    "torque-order": "push one joint after another by hand: only its torque must change",
    "torque-delay": "step the torque of one joint: its acceleration must follow at once",
    "torque-without-gravity": "hold the stretched arm still: its torque must hold it against gravity",
    "joint-sign": "turn one joint after another by hand, and watch the sign of its position",
    "joint-order": "turn one joint after another by hand, and watch which position changes",
    "encoder-offset": "move the joint to its zero mark: its position must be zero there",
    "base-tilted": "put a spirit level on the base",
    "gravity-direction": "see how the base is mounted",
    "payload-missing": "weigh what is mounted on the last link",
    "masses-mismatch": "compare the masses with those of the maker",
}
"""What shows whether a kind of fault is there, in the order in which it is tried."""


def alternatives_of(
    system: ConstrainedSystem, chosen: Tried, tried: Iterable[Tried], null: Fit
) -> Iterator[Tried]:
    """The hypotheses that held-out blocks cannot tell from the chosen one.

    Each lowers the error on its own, within one standard error of as far as the chosen one, block by block.
    """
    for hypothesis, fit in tried:
        if _says_the_same(chosen[0], hypothesis):
            continue
        gain, error = gain_of(fit.score, null.score)
        loss, apart = gain_of(chosen[1].score, fit.score)
        if gain > ALONE * error and abs(loss) <= apart and _possible(system, hypothesis, fit):
            yield hypothesis, fit


def _says_the_same(chosen: Hypothesis, other: Hypothesis) -> bool:
    """Whether a hypothesis is the chosen one with other numbers, or contains it, as masses contain a tool."""
    if (chosen.name, other.name) == ("payload", "masses"):
        return True
    return other.name == chosen.name and (not other.joints or bool({*other.joints} & {*chosen.joints}))


def _possible(system: ConstrainedSystem, hypothesis: Hypothesis, fit: Fit) -> bool:
    """Whether every link has a positive mass, which masses that were merely fitted need not be."""
    if hypothesis.name != "masses":
        return True
    return bool((system.robot.mass.numpy() + fit.theta[: 10 * system.robot.nq : 10] > 0.0).all())


def with_alternatives(finding: Finding, others: Iterable[Finding]) -> Finding:
    """A finding that names what else it may be, if anything, and what would tell them apart."""
    found: list[Finding] = []
    for other in others:
        same = (f for f in (finding, *found) if f.kind == other.kind and {*f.joints} & {*other.joints})
        if next(same, None) is None:
            found.append(other)
    if not found:
        return finding
    message = "; or ".join(one.message for one in (finding, *found))
    test = next(TESTS[kind] for kind in TESTS if kind in {finding.kind, *(f.kind for f in found)})
    return replace(finding, message=message, alternatives=tuple(found), told_apart_by=test)
