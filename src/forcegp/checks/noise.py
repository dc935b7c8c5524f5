"""Is the noise on the acceleration white, and as large as the header says?

The departure of a sample from the cubic through its neighbours at distances k and 2k shows the noise around
the frequency 1/(2 k dt), and hardly any motion. White noise shows alike at k = 1 and k = 3; filtered noise
does not.
"""

from __future__ import annotations

import numpy as np

from forcegp.checks.clock import Outcome
from forcegp.checks.finding import Finding
from forcegp.checks.log import Log
from forcegp.checks.statistics import Array
from forcegp.constraints import ConstrainedSystem
from forcegp.robust import robust_std

WEIGHTS = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0
"""The departure, with signs: it vanishes on cubics."""
STRIDE = 3
"""Distance of neighbours that shows noise below the corner of a filter."""
FACTOR = 2.0
"""Ratio of noise found to noise stated that is reported."""
FILTERED = 0.4
"""Noise at the highest frequency, as a share of that at a third of it, that tells a filter."""
LEAST_ROWS = 100


def noise_levels(log: Log) -> tuple[Array, Array] | None:
    """Standard deviation `(nq,)` of white noise as neighbours at distance 1 and at distance 3 show it."""
    levels = []
    for k in (1, STRIDE):
        parts = []
        for s in log.stretches:
            x, span = log.qdd[s], 4 * k
            if len(x) > span:
                parts.append(sum(w * x[i * k : len(x) - span + i * k] for i, w in enumerate(WEIGHTS)))
        rest = np.concatenate(parts) if parts else np.empty((0, log.nq))
        if len(rest) < LEAST_ROWS:
            return None
        levels.append(robust_std(rest) / np.linalg.norm(WEIGHTS))
    return levels[0], levels[1]


def check_noise(system: ConstrainedSystem, log: Log) -> Outcome:
    """The noise of the logged acceleration against that of the header."""
    levels = noise_levels(log) if np.isfinite(log.dt) and "qdd" not in log.derived else None
    if levels is None:
        return [], log
    top, middle = levels
    stated = log.header.noise_std
    filtered = top < FILTERED * middle
    evidence = {"white_noise_std": float(np.median(top)), "std_at_a_third": float(np.median(middle))}
    if stated is None:
        # Without a claim of white noise a filter contradicts nothing, but a likelihood has to know.
        weight = "note"
    else:
        evidence["stated_std"] = stated
        filtered &= top < stated / FACTOR
        weight = "warning"
    if filtered.mean() > 0.5 and not log.header.filtered:
        joints = tuple(log.joint_names[j] for j in np.flatnonzero(filtered))
        text = (
            f"the acceleration is filtered: at the highest frequencies it holds "
            f"{100 * np.median(top / middle):.2g} % of the noise that it holds at a third of them, "
            "so its noise is not white"
        )
        return [Finding("noise-filtered", text, log.all_rows, joints, evidence=evidence, weight=weight)], log
    return (_stated(log, top, stated, evidence) if stated is not None else []), log


def _stated(log: Log, found: Array, stated: float, evidence: dict[str, float]) -> list[Finding]:
    kinds = {"noise-understated": found > FACTOR * stated}
    if not log.header.filtered:  # the highest frequencies show little of what a filter lets through
        kinds["noise-overstated"] = found < stated / FACTOR
    result = []
    for kind, wrong in kinds.items():
        if wrong.any():
            joints = tuple(log.joint_names[j] for j in np.flatnonzero(wrong))
            worst = found[wrong].max() if kind == "noise-understated" else found[wrong].min()
            place = f"{worst:.3g} rad/s² at {', '.join(joints)}"
            text = f"the noise of qdd is {place}, and the header states {stated:.3g}"
            result.append(Finding(kind, text, log.all_rows, joints, evidence=evidence))
    return result
