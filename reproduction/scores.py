"""Errors, uncertainty, constraint and cost of every model: tables and findings."""

from __future__ import annotations

from itertools import pairwise

from forcegp import report
from reproduction.learning import paper_value
from reproduction.results import GP_MODELS, SPLITS, PaperNumbers, Results, like
from reproduction.statements import Statement, number

RESIDUAL = 1e-11
"""Mean constraint residual attributed to rounding [m/s²]."""
COVERAGE = (0.93, 0.98)
"""±2σ coverage that counts as calibrated; 0.954 for a normal distribution."""
CLOSE = 0.15
"""Relative difference up to which two errors count as equal."""
MEGABYTE = 1e6


def error_table(results: Results, paper: PaperNumbers) -> report.Table:
    """Return the errors of every model at its largest size, on both splits, with the paper's errors."""
    rows = []
    for model in results.models:
        points = results.sizes(model)[-1]
        cells = [
            number(results.values(model, split, points, f"{kind}_mae"), 4)
            for split in SPLITS
            for kind in ("noisy", "clean")
        ]
        theirs = paper_value(paper, paper.beside(results, model), points)
        rows.append((report.label(model), str(points), *cells, theirs))
    ours = [f"{kind}, {split}" for split in ("held out", "paper's split") for kind in ("noisy", "clean")]
    head = ("model", "N", *ours, "noisy, paper")
    return report.Table("Mean absolute error of predicted accelerations [rad/s²]", head, tuple(rows))


def overview_table(results: Results) -> report.Table:
    """Return the summary table at the top of the page."""
    rows = []
    for model in (m for m in results.models if m not in ("nn-30-20", "nn-200x4") and not m.endswith("-se")):
        points = results.sizes(model)[-1]
        measures = (("clean_mae", 4), ("coverage_noisy", 3), ("residual", 3))
        cells = [number(results.values(model, "stretches", points, m), digits) for m, digits in measures]
        rows.append((report.label(model), str(points), *cells))
    return report.Table(
        "Motion without training points: error against noise-free q̈, coverage of noisy q̈",
        ("model", "N", "error [rad/s²]", "±2σ coverage", "|A q̈ − b| [m/s²]"),
        tuple(rows),
    )


def quality_table(results: Results) -> report.Table:
    """Return the coverage, density, constraint residual and cost of every model on held-out stretches."""
    rows = []
    for model in results.models:
        points = results.sizes(model)[-1]
        own = [s for s in results.scores if (s.model, s.split, s.points) == (model, "stretches", points)]
        measures = ("coverage_noisy", "coverage_clean", "nlpd", "residual")
        cells = [number(results.values(model, "stretches", points, name)) for name in measures]
        memory = [None if s.peak_memory is None else s.peak_memory / MEGABYTE for s in own]
        cost = [
            number([s.fit_seconds for s in own], 1),
            number([1e3 * s.predict_seconds / s.test_samples for s in own], 2),
            number(memory, 0),
        ]
        rows.append((report.label(model), str(points), *cells, *cost))
    coverage = ("±2σ coverage (noisy)", "±2σ coverage (clean)")
    cost = ("fit [s]", "predict [ms/sample]", "peak memory [MB]")
    head = ("model", "N", *coverage, "NLPD [nats]", "mean |A q̈ − b| [m/s²]", *cost)
    return report.Table("Uncertainty, constraint and cost, held-out stretches", head, tuple(rows))


def order(results: Results) -> Statement | None:
    """Return the order of the models by held-out error, in the pairs that the paper compares.

    Structured models and the GP are compared at their largest common number of training points, with the
        paper's kernel; the analytical model and the networks are compared with the GP at the largest sizes.
    """
    chain = [like(results, m) for m in ("gp", "sgp-zero", "sgp-mean") if m in results.models]
    sizes = [{n for n in results.sizes(m) if results.values(m, "stretches", n, "noisy_mae")} for m in chain]
    common = set.intersection(*sizes) if sizes else set()
    if len(chain) < 2 or not common:
        return None
    n = max(common)
    pairs = [_pair(results, (a, n), (b, n)) for a, b in pairwise(chain)]
    if "gp" in chain:
        gp = "gp", results.sizes("gp")[-1]
        largest = {m: results.mean(m, "stretches", None, "noisy_mae") for m in results.models}
        known = {m: e for m, e in largest.items() if e is not None}
        networks = [m for m in known if m.startswith("nn")]
        if networks:
            best = min(networks, key=lambda m: known[m])
            pairs.append(_pair(results, (best, results.sizes(best)[-1]), gp, close=True))
        if "analytical" in known:
            pairs.append(_pair(results, ("analytical", results.sizes("analytical")[-1]), gp))
    listed = "; ".join(text for _, text in pairs)
    text = f"Error on held-out stretches [rad/s²], beside the paper's order: {listed}."
    return Statement("Order of the models", all(same for same, _ in pairs), text)


def _pair(
    results: Results, first: tuple[str, int], second: tuple[str, int], close: bool = False
) -> tuple[bool, str]:
    """Return whether the first model is worse than the second or about equal, with a sentence on it."""
    (a, n), (b, m) = first, second
    one, two = results.mean(a, "stretches", n, "noisy_mae"), results.mean(b, "stretches", m, "noisy_mae")
    assert one is not None and two is not None
    alike = abs(one / two - 1.0) <= CLOSE
    found = "about as good as" if close and alike else "worse than" if one >= two else "better than"
    wanted = "about as good as" if close else "worse than"
    beside = "as in the paper" if found == wanted else f"in the paper {wanted} it"
    ours, other = f"{report.label(a)} ({n} points) {one:.3f}", f"{report.label(b)} ({m} points) {two:.3f}"
    text = f"{ours} is {found} {other}, {beside}"
    return found == wanted, text


def splits(results: Results) -> Statement | None:
    """Return a statement on how much the paper's split underestimates errors."""
    rows = []
    for model in (m for m in GP_MODELS if m in results.models):
        held, papers = (results.mean(model, split, None, "clean_mae") for split in SPLITS)
        rows += [f"{report.label(model)} {held:.4f} against {papers:.4f}"] if held and papers else []
    text = (
        "Clean error on stretches of motion without any training point, against the paper's split, whose "
        f"test samples lie next to training points: {'; '.join(rows)} rad/s²."
    )
    return Statement("Held-out stretches", None, text) if rows else None


def calibration(results: Results) -> Statement | None:
    """Return whether the ±2σ bands have the right coverage."""
    models = (m for m in GP_MODELS if m in results.models)
    found = {m: results.mean(m, "stretches", None, "coverage_noisy") for m in models}
    shares = {m: share for m, share in found.items() if share is not None}
    outside = [report.label(m) for m, share in shares.items() if not COVERAGE[0] <= share <= COVERAGE[1]]
    listed = ", ".join(f"{report.label(m)} {share:.3f}" for m, share in shares.items())
    verdict = f"not calibrated: {', '.join(outside)}" if outside else "all are calibrated"
    text = f"±2σ coverage of noisy accelerations (nominal 0.954): {listed}; {verdict}."
    return Statement("Uncertainty", not outside, text) if shares else None


def constraint(results: Results) -> Statement | None:
    """Return whether predictions obey the constraint."""
    found = {m: [s.residual for s in results.scores if s.model == m and s.residual] for m in GP_MODELS}
    worst = {m: max(values) for m, values in found.items() if values}
    listed = ", ".join(f"{report.label(m)} {value:.1e}" for m, value in worst.items())
    agrees = all(value <= RESIDUAL for m, value in worst.items() if m != "gp")
    verdict = (
        "structured models obey the constraint to rounding"
        if agrees
        else f"a structured model is above {RESIDUAL:.0e}, which should not happen"
    )
    text = f"Largest mean |A q̈ − b| over all fits: {listed} m/s²; {verdict}."
    return Statement("Constraint", agrees, text) if worst else None
