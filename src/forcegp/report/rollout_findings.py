"""What the trajectories say: tip error in open loop, and whether bands hold the simulated motion."""

from __future__ import annotations

import math

from forcegp.report.finding import Finding
from forcegp.report.rollout_data import RolloutData
from forcegp.report.style import label

HORIZON = 1.0
"""Time at which tip errors are compared [s]."""
FIFTH = 0.2
"""Part of the other models' tip error that the S-GP with analytical mean is to stay below."""
HELD = (0.80, 0.97)
"""Share of simulated tip positions in 90 % bands that counts as honest."""
OURS = "sgp-mean"


def tip_error(data: RolloutData) -> Finding | None:
    """The S-GP with analytical mean against models that do not learn forces, one second ahead."""
    if HORIZON not in data.horizons:
        return None
    at = data.horizons.index(HORIZON)
    errors = {p.model: math.inf if p.errors[at] is None else p.errors[at] for p in data.models}
    others = {m: e for m, e in errors.items() if e is not None and not m.startswith("sgp")}
    ours = errors.get(OURS)
    if ours is None or not others:
        return None
    ratios = {m: ours / e if math.isfinite(ours) else math.inf for m, e in others.items()}
    listed = "; ".join(f"{label(m)} {_millimetres(e)}, ratio {ratios[m]:.2g}" for m, e in others.items())
    structured = {m: e for m, e in errors.items() if e is not None and m.startswith("sgp") and m != OURS}
    beside = "".join(f"; {label(m)} {_millimetres(e)}" for m, e in structured.items())
    reached = all(ratio <= FIFTH for ratio in ratios.values())
    text = (
        f"Open loop, median over {data.starts} starts, {HORIZON:g} s ahead: {label(OURS)} "
        f"{_millimetres(ours)} (to be at most a fifth of the following); {listed}{beside}."
    )
    return Finding("Tip error of trajectories", reached, text)


def bands(data: RolloutData) -> Finding | None:
    """Whether bands over function samples hold as much of the simulated motion as they should."""
    sampled = [path for path in data.models if path.coverage is not None]
    if not sampled:
        return None
    calibrated = all(path.calibrated_coverage is not None for path in sampled)
    listed = []
    for path in sampled:
        text = f"{label(path.model)} {path.coverage:.3f}"
        if path.calibrated_coverage is not None:
            text += f", widened by {path.inflation:.2f} {path.calibrated_coverage:.3f}"
        listed.append(text)
    shares = {p.model: p.calibrated_coverage if calibrated else p.coverage for p in sampled}
    outside = [label(m) for m, s in shares.items() if s is None or not HELD[0] <= s <= HELD[1]]
    text = (
        f"Share of simulated tip positions in {data.level:.0%} bands over function samples, "
        f"{data.band_starts} starts, {data.band_seconds:.3g} s (wanted: {HELD[0]:.2f} to {HELD[1]:.2f}), "
        + ("as they are and widened to hold held-out stretches of the training run: " if calibrated else "")
        + "; ".join(listed)
        + (f"; outside: {', '.join(outside)}." if outside else ".")
    )
    return Finding("Bands of trajectories", not outside, text)


def _millimetres(error: float) -> str:
    return f"{1e3 * error:.3g} mm" if math.isfinite(error) else "diverged"
