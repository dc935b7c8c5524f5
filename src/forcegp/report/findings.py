"""What the numbers say, beside the paper: sentences computed from the results, none of them fixed."""

from __future__ import annotations

from itertools import pairwise

from forcegp.report.curves import FLOOR
from forcegp.report.data import (
    GP_MODELS,
    IdentificationData,
    IdentificationRun,
    MultiplierData,
    PaperNumbers,
    Results,
    Score,
)
from forcegp.report.finding import Finding
from forcegp.report.rollout_data import RolloutData
from forcegp.report.rollout_findings import bands, tip_error
from forcegp.report.style import label
from forcegp.report.tables import largest, models_of, pick

RESIDUAL = 1e-11
"""Mean constraint residual below which the rest is rounding [m/s²]."""
COVERAGE = (0.93, 0.98)
"""Share within two standard deviations that counts as calibrated; 0.954 for a normal distribution."""
MASS_TOLERANCE, OFFSET_TOLERANCE = 0.02, 1e-3
INSIDE = 0.90
CLOSE = 0.15
"""Relative difference up to which two errors count as about the same."""


def findings(
    results: Results,
    paper: PaperNumbers,
    multiplier: MultiplierData | None,
    identification: IdentificationData | None,
    rollouts: RolloutData | None,
) -> list[Finding]:
    """All readings that the results allow."""
    found = [
        _against_paper(results, paper, model) for model in paper.noisy_mae if model in models_of(results)
    ]
    found += [_order(results), _efficiency(results, paper), _splits(results), _calibration(results)]
    found += [_residual(results)]
    found += [_multiplier(multiplier)] if multiplier and multiplier.bands else []
    found += [_identification(identification)] if identification and identification.runs else []
    found += [tip_error(rollouts), bands(rollouts)] if rollouts else []
    return [finding for finding in found if finding is not None]


def _mean(scores: list[Score], name: str) -> float | None:
    values = [v for s in scores if (v := getattr(s, name)) is not None]
    return sum(values) / len(values) if values else None


def _against_paper(results: Results, paper: PaperNumbers, model: str) -> Finding | None:
    """Our error on the paper's split against the paper's, at every N that both have."""
    pairs = []
    for points, theirs in zip(paper.points, paper.noisy_mae[model], strict=True):
        ours = _mean(pick(results, model, "selection", points), "noisy_mae")
        pairs += [] if ours is None else [(points, ours, theirs)]
    if not pairs:
        return None
    above = [p for p in pairs if p[1] > p[2]]
    listed = "; ".join(f"N = {n}: {ours:.3f}, paper {theirs:g}" for n, ours, theirs in pairs)
    if not above:
        return Finding(
            f"{label(model)} against the paper", True, f"At or below the paper's error at every N. {listed}."
        )
    text = (
        f"Above the paper's error at N = {', '.join(str(p[0]) for p in above)}. {listed}. The paper does "
        "not give its rectangle, travel times, pressing force or test window; faster or wider motion "
        "than its own makes the same number of points cover less."
    )
    return Finding(f"{label(model)} against the paper", False, text)


def _order(results: Results) -> Finding | None:
    """The models by their error on held-out stretches, beside the paper's order."""
    errors = {
        m: _mean(pick(results, m, "stretches", largest(results, m)), "noisy_mae") for m in models_of(results)
    }
    known = {m: e for m, e in errors.items() if e is not None}
    paper = [m for m in ("gp", "sgp-zero", "sgp-mean") if m in known]
    if len(paper) < 2:
        return None
    agrees = all(known[a] >= known[b] for a, b in pairwise(paper))
    ranked = sorted(known, key=lambda m: -known[m])
    listed = ", ".join(f"{label(m)} ({largest(results, m)} points) {known[m]:.3f}" for m in ranked)
    text = f"From the worst to the best, rad/s² on held-out stretches: {listed}."
    networks = [m for m in known if m.startswith("nn")]
    if networks and "gp" in known:
        best = min(networks, key=lambda m: known[m])
        ratio = known[best] / known["gp"]
        close = (
            "about the same as"
            if abs(ratio - 1.0) <= CLOSE
            else "better than"
            if ratio < 1.0
            else "worse than"
        )
        text += (
            f" The best network ({label(best)}, {largest(results, best)} points) is {close} the GP with "
            f"{largest(results, 'gp')} points; in the paper they are about the same with 10,000 and 1,000."
        )
    if "analytical" in known and "gp" in known:
        worse = known["analytical"] > known["gp"]
        text += (
            " The analytical model without contact friction is "
            + ("worse than" if worse else "better than")
            + " the GP on the mean of all joints"
            + (", as in the paper." if worse else ": its error sits in the last joints, near the surface.")
        )
    return Finding("Order of the models", agrees, text)


def _efficiency(results: Results, paper: PaperNumbers) -> Finding | None:
    """With how many points the zero-mean structured model reaches the paper's best."""
    target = paper.noisy_mae["sgp-zero"][-1]
    sizes = sorted({s.points for s in results.scores if s.model == "sgp-zero"})
    errors = {n: _mean(pick(results, "sgp-zero", "selection", n), "noisy_mae") for n in sizes}
    reached = [n for n, e in errors.items() if e is not None and e <= target]
    if not sizes:
        return None
    least = f"with N = {reached[0]}" if reached else f"with none of N = {', '.join(map(str, sizes))}"
    text = (
        f"The zero-mean S-GP reaches the paper's error at N = {paper.points[-1]} ({target:g} rad/s²) "
        f"{least} on the paper's split. The floor of this metric is the mean magnitude of the noise "
        f"itself, {FLOOR * results.noise_std:.4f} rad/s²: near it, only the error against noise-free "
        "accelerations tells models apart."
    )
    return Finding("Points needed", bool(reached) and reached[0] <= paper.points[1], text)


def _splits(results: Results) -> Finding | None:
    """How much the paper's split flatters."""
    rows = []
    for model in (m for m in GP_MODELS if m in models_of(results)):
        n = largest(results, model)
        ours = [_mean(pick(results, model, split, n), "clean_mae") for split in ("stretches", "selection")]
        rows += [(model, ours[0], ours[1])] if ours[0] and ours[1] else []
    if not rows:
        return None
    listed = "; ".join(f"{label(m)} {held:.4f} against {papers:.4f}" for m, held, papers in rows)
    return Finding(
        "Held-out stretches",
        None,
        "Clean error on stretches of motion without a single training point, against the paper's split, "
        f"whose test samples lie next to training points: {listed} rad/s².",
    )


def _calibration(results: Results) -> Finding | None:
    """Whether two standard deviations hold what they should."""
    rows = []
    for model in (m for m in GP_MODELS if m in models_of(results)):
        share = _mean(pick(results, model, "stretches", largest(results, model)), "coverage_noisy")
        rows += [(model, share)] if share is not None else []
    if not rows:
        return None
    outside = [m for m, share in rows if not COVERAGE[0] <= share <= COVERAGE[1]]
    listed = ", ".join(f"{label(m)} {share:.3f}" for m, share in rows)
    verdict = (
        "all are calibrated" if not outside else "not calibrated: " + ", ".join(label(m) for m in outside)
    )
    text = (
        f"Share of noisy accelerations within two standard deviations (0.954 is right): {listed}; {verdict}."
    )
    return Finding("Uncertainty", not outside, text)


def _residual(results: Results) -> Finding | None:
    """Whether predictions obey the constraint."""
    rows = []
    for model in (m for m in GP_MODELS if m in models_of(results)):
        worst = [s.residual for s in results.scores if s.model == model and s.residual is not None]
        rows += [(model, max(worst))] if worst else []
    if not rows:
        return None
    listed = ", ".join(f"{label(m)} {value:.1e}" for m, value in rows)
    agrees = all(value <= RESIDUAL for m, value in rows if m != "gp")
    verdict = (
        "structured models obey the constraint to rounding"
        if agrees
        else f"above {RESIDUAL:.0e} for a structured model, which should not be"
    )
    return Finding("Constraint", agrees, f"Largest mean |A q̈ − b| over all fits: {listed} m/s²; {verdict}.")


def _multiplier(data: MultiplierData) -> Finding:
    """Whether the multiplier is positive and within its band."""
    listed = "; ".join(
        f"{label(b.model)}: within the band for {100 * b.inside:.0f} %"
        + ("" if b.inside_held_out is None else f" ({100 * b.inside_held_out:.0f} % of held-out samples)")
        + f", mean error {b.mean_error:.2f} N, least {b.smallest:.1f} N"
        for b in data.bands
    )
    informed = [b for b in data.bands if b.model != "sgp-zero"]
    agrees = all(b.inside >= INSIDE and b.smallest > 0.0 for b in informed)
    text = f"λ predicted from accelerations alone, over {data.t[-1] - data.t[0]:.0f} s: {listed}."
    if len(informed) < len(data.bands):
        text += (
            " Accelerations do not tell the force along the surface normal, as H Aᵀ = 0; with a zero mean "
            "nothing else does, so only models with the analytical mean (eq. 25) can be right about λ."
        )
    return Finding("Multiplier", agrees, text)


def _identification(data: IdentificationData) -> Finding:
    """Whether mass and offset are found."""
    words, good = [], []
    for model in dict.fromkeys(run.model for run in data.runs):
        runs = [run for run in data.runs if run.model == model]
        mass = max(abs(run.mass[-1] - data.true_mass) for run in runs)
        offset = max(abs(axis[-1]) for run in runs for axis in run.offset)
        ok = mass <= MASS_TOLERANCE and offset <= OFFSET_TOLERANCE
        good += [ok] if model != "analytical" else []
        when = max(_settled(run, data.true_mass) for run in runs) if ok else 0
        words.append(
            f"{label(model)}: mass off by {mass:.4f} kg, offset by {1e3 * offset:.2f} mm"
            + (f", within tolerance from evaluation {when} on" if ok else "")
        )
    text = f"After learning from {data.points} points without knowing the friction (worst seed): "
    return Finding("Identification", all(good), text + "; ".join(words) + ".")


def _settled(run: IdentificationRun, true_mass: float) -> int:
    """The evaluation from which on mass and offset stay within tolerance."""
    last = 0
    for i, mass in enumerate(run.mass):
        off = max(abs(axis[i]) for axis in run.offset)
        if abs(mass - true_mass) > MASS_TOLERANCE or off > OFFSET_TOLERANCE:
            last = i + 1
    return last
