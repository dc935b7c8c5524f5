"""Is time a clock: forward, even, without gaps, and the period that the header states?"""

from __future__ import annotations

import numpy as np

from forcegp.checks.finding import Finding
from forcegp.checks.log import Log
from forcegp.checks.statistics import describe, intervals
from forcegp.constraints import ConstrainedSystem
from forcegp.data.derivative import UNIFORM_TOLERANCE
from forcegp.robust import robust_std

Outcome = tuple[list[Finding], Log]
"""What a check returns: its findings, and the log as those after it should see it."""


def _after(mask: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Rows at the end of the steps that a mask over steps picks."""
    return intervals(np.concatenate([[False], mask]))


def check_order(system: ConstrainedSystem, log: Log) -> Outcome:
    """Time stamps that repeat or run backward within a segment."""
    if not log.header.ordered:
        return [], log
    found = []
    for kind, mask in (("time-repeated", log.steps == 0.0), ("time-backward", log.steps < 0.0)):
        if mask.any():
            rows = _after(mask)
            word = "repeats" if kind == "time-repeated" else "runs backward"
            found.append(
                Finding(kind, f"time {word} in {describe(rows)}", rows, evidence={"steps": mask.sum()})
            )
    wrong = np.concatenate([[False], log.steps <= 0.0])
    return found, log.mask(wrong) if found else log


def check_gaps(system: ConstrainedSystem, log: Log) -> Outcome:
    """Steps that are longer than the clock's jitter allows: samples are missing."""
    with np.errstate(invalid="ignore"):
        gaps = log.steps > log.longest_step
    if log.masked is not None:
        # The step after a wrong time stamp is long because of that stamp.
        gaps &= ~log.masked[:-1]
    if not gaps.any() or not log.header.ordered:
        return [], log
    rows, longest = _after(gaps), float(np.nanmax(log.steps))
    missing = int(np.round(log.steps[gaps] / log.dt - 1.0).sum())
    text = (
        f"about {missing} samples are missing before {describe(rows)}; the longest gap takes {longest:.4g} s"
    )
    evidence = {"missing_samples": missing, "longest_s": longest, "period_s": log.dt}
    return [Finding("time-gap", text, rows, evidence=evidence)], log


def check_jitter(system: ConstrainedSystem, log: Log) -> Outcome:
    """Steps that are so uneven that filters for even sampling do not apply."""
    with np.errstate(invalid="ignore"):
        regular = log.steps[(log.steps > 0.0) & (log.steps <= log.longest_step)]
    if len(regular) < 2 or not log.header.ordered:
        return [], log
    spread = float(robust_std(regular) / log.dt)
    if spread <= UNIFORM_TOLERANCE:
        return [], log
    text = f"the time steps vary by {100 * spread:.2g} % around {log.dt:.4g} s"
    evidence = {"relative_spread": spread, "period_s": log.dt}
    return [Finding("time-jitter", text, log.all_rows, evidence=evidence)], log


def check_period(system: ConstrainedSystem, log: Log) -> Outcome:
    """The sampling period against that of the header."""
    stated = log.header.dt
    if (
        stated is None
        or not log.header.ordered
        or not np.isfinite(log.dt)
        or abs(log.dt / stated - 1.0) <= UNIFORM_TOLERANCE
    ):
        return [], log
    text = f"the header states a period of {stated:.4g} s, and the rows are {log.dt:.4g} s apart"
    evidence = {"stated_s": stated, "period_s": log.dt}
    return [Finding("period-header", text, log.all_rows, evidence=evidence)], log
