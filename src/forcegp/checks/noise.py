"""Is the noise on the acceleration white, and as large as the header says?

White noise of standard deviation σ has the spectral density 2σ² dt at all frequencies. Motion lies at low ones,
so the density near the Nyquist frequency shows σ; a filter takes the noise away there and leaves it below.
"""

from __future__ import annotations

import numpy as np

from forcegp.checks.clock import Outcome
from forcegp.checks.finding import Finding
from forcegp.checks.log import Log
from forcegp.checks.statistics import Array
from forcegp.constraints import ConstrainedSystem

SEGMENT = 256
"""Samples of each periodogram."""
TOP = (0.8, 0.98)
"""Band that shows white noise, as shares of the Nyquist frequency."""
MIDDLE = (0.3, 0.5)
"""Band that shows noise below the corner of a filter."""
FACTOR = 2.0
"""Ratio of noise found to noise stated that is reported."""
FILTERED = 0.2
"""Amplitude near the Nyquist frequency, as a share of that in the middle, that tells a filter."""


def noise_levels(log: Log) -> tuple[Array, Array] | None:
    """Standard deviation `(nq,)` of white noise with the density found in the top and in the middle band."""
    from scipy.signal import welch

    spectra = []
    for s in log.stretches:
        if s.stop - s.start >= SEGMENT:
            # The median over periodograms keeps impacts out.
            f, density = welch(log.qdd[s], 1.0 / log.dt, "hann", SEGMENT, axis=0, average="median")
            spectra.append((s.stop - s.start, density))
    if not spectra:
        return None
    mean = sum(n * d for n, d in spectra) / sum(n for n, _ in spectra)
    share = f / f[-1]
    levels = []
    for low, high in (TOP, MIDDLE):
        band = (share >= low) & (share <= high)
        levels.append(np.sqrt(np.median(mean[band], axis=0) / (2.0 * log.dt)))
    return levels[0], levels[1]


def check_noise(system: ConstrainedSystem, log: Log) -> Outcome:
    """The noise of the logged acceleration against that of the header."""
    levels = noise_levels(log) if np.isfinite(log.dt) else None
    if levels is None:
        return [], log
    top, middle = levels
    stated = log.header.noise_std
    filtered = top < FILTERED * middle
    evidence = {"white_noise_std": float(np.median(top)), "middle_band_std": float(np.median(middle))}
    if stated is None:
        # Without a claim of white noise a filter is no contradiction, but a likelihood has to know.
        weight = "note"
    else:
        evidence["stated_std"] = stated
        filtered &= top < stated / FACTOR
        weight = "warning"
    if filtered.mean() > 0.5:
        joints = tuple(log.joint_names[j] for j in np.flatnonzero(filtered))
        text = (
            "the acceleration is filtered: near the Nyquist frequency it holds "
            f"{100 * np.median(top / middle):.2g} % of the amplitude at half of it, so its noise is not white"
        )
        return [Finding("noise-filtered", text, log.all_rows, joints, evidence=evidence, weight=weight)], log
    return (_stated(log, top, stated, evidence) if stated is not None else []), log


def _stated(log: Log, found: Array, stated: float, evidence: dict[str, float]) -> list[Finding]:
    kinds = {"noise-understated": found > FACTOR * stated, "noise-overstated": found < stated / FACTOR}
    result = []
    for kind, wrong in kinds.items():
        if wrong.any():
            joints = tuple(log.joint_names[j] for j in np.flatnonzero(wrong))
            worst = found[wrong].max() if kind == "noise-understated" else found[wrong].min()
            text = f"the noise of qdd is {worst:.3g} rad/s² at {', '.join(joints)}, and the header states {stated:.3g}"
            result.append(Finding(kind, text, log.all_rows, joints, evidence=evidence))
    return result
