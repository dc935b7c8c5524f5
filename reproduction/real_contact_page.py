"""`python -m reproduction --profile real-contact`: runs the pipeline on its scenes and writes the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from benchmarks.foreign_log import selected
from forcegp import report
from forcegp.data import Dataset
from forcegp.destination import check_destination
from forcegp.files import write_json, write_text
from forcegp.scene import load_scene
from reproduction import real_contact
from reproduction.multiplier import MultiplierBand, MultiplierData, draw_multiplier, spans
from reproduction.stages import Say, Stage, run_stages
from reproduction.statements import Statement, markdown

PROFILE, PAGE, RESULTS, MARKDOWN = "real-contact", "report.html", "results.json", "results.md"
DURATION = 60.0
"""Simulated time of each scene [s]."""
SHOWN = 1500
"""Number of rows of the force that the page shows."""
GAP = 0.5
"""Minimum time between two stretches [s]."""
NAMES = {
    "file": "robot file",
    "torques": "sgp",
    "sensor": "sgp with wrist sensor",
}
ROWS_RIGHT, OFFSET_MM, TILT_DEGREES = 0.99, 0.2, 0.2
"""Requirements for contact detection and the surface fit."""
BIAS, SPREAD, CORRELATION, COVERAGE = 0.4, 1.2, 0.95, (0.90, 0.98)
"""Requirements for the normal force: maximum bias and spread [N], correlation, ±2σ coverage."""


def run_real_contact(
    out: str | Path = "out",
    *,
    seed: int = 0,
    duration: float = DURATION,
    scenes: tuple[str, ...] = real_contact.SCENES,
    processes: int = 1,
    say: Say = lambda *_: None,
) -> dict[str, object]:
    """Run the pipeline from log to contact force on MuJoCo's scenes; finished stages are not run again.

    Args:
        out: folder for the page and everything it is made from.
        seed: seed for the simulated runs.
        duration: duration of each run [s].
        scenes: names of the scenes.
        processes: number of stages to run in parallel.
        say: called when a stage ends.

    Returns:
        The main numbers by name, the page last.
    """
    root = Path(out)
    check_destination(root, folder=True)
    lines = [real_contact.line_of(root / "stages", scene, duration, seed) for scene in scenes]
    stages = [stage for line in lines for stage in (line.run, line.log, *line.fits.values())]
    run_stages(stages, processes, say)
    results = {
        line.scene: real_contact.numbers_of(line.log, real_contact.IMPORTED)
        | {variant: _force_score(stage) for variant, stage in line.fits.items()}
        for line in lines
    }
    seconds = sum(header.seconds for stage in stages if (header := stage.found()) is not None)
    write_json(root / RESULTS, results)
    write_text(root / MARKDOWN, "\n\n".join(markdown(t) for t in tables(results)) + "\n")
    page = report.render(
        "real_contact.html.j2",
        package="reproduction",
        tables=tables(results),
        findings=findings(results),
        blocks=[_block(line) for line in lines],
        checks={scene: found["check"] for scene, found in results.items()},
        seconds=seconds,
    )
    write_text(root / PAGE, page)
    numbers: dict[str, object] = {"profile": PROFILE, "computing_time_s": round(seconds, 1)}
    for scene, found in results.items():
        for source, share in found["rows_right"].items():
            numbers[f"{scene}_rows_right_by_{source}"] = round(share, 4)
        for variant in real_contact.VARIANTS:
            score = found[variant]
            numbers[f"{scene}_{variant}_force_N"] = f"{score['bias']:+.2f} ± {score['spread']:.2f}"
    return numbers | {"report": str(root / PAGE)}


def _force_score(stage: Stage) -> dict[str, Any]:
    """Return λ against the simulator's force, and the coverage of accelerations."""
    found = real_contact.numbers_of(stage, real_contact.EVALUATED)
    coverage = (found["uncertainty"] or {}).get("coverage_noisy")
    force = (found["sensed"] or found["multipliers"])[0]
    return force | {"acceleration_rmse": found["noisy"]["rmse"], "qdd_coverage": coverage}


def tables(results: dict[str, dict[str, Any]]) -> tuple[report.Table, report.Table]:
    """Return two tables: contact and surface, and normal force by model."""
    found = [
        (
            scene,
            *(f"{100 * share:.2f} %" for share in numbers["rows_right"].values()),
            report.cell(numbers["surface"]["offset_mm"], 2),
            report.cell(numbers["surface"]["tilt_degrees"], 2),
            numbers["check"]["verdict"].removeprefix("verdict: "),
        )
        for scene, numbers in results.items()
    ]
    sources = [f"rows right by {source}" for source in next(iter(results.values()))["rows_right"]]
    head = ("scene", *sources, "surface offset [mm]", "tilt [°]", "verdict of the check")
    first = report.Table(
        "Contact found in the log, and the surface fitted to the tip's path", head, tuple(found)
    )
    rows = []
    for scene, numbers in results.items():
        for variant, name in NAMES.items():
            score = numbers[variant]
            force = f"{score['bias']:+.2f} ± {score['spread']:.2f}"
            shares = (
                report.cell(score["correlation"], 3),
                report.cell(score["coverage"], 3),
                report.cell(score["qdd_coverage"], 3),
            )
            rows.append((f"{scene}: {name}", force, *shares, report.cell(score["acceleration_rmse"], 3)))
    head = ("model", "λ error [N]", "correlation", "±2σ of λ", "±2σ of q̈", "q̈ error [rad/s²]")
    return first, report.Table("Normal force against MuJoCo's, held-out rows in contact", head, tuple(rows))


def findings(results: dict[str, dict[str, Any]]) -> list[Statement]:
    """Return the requirements, and whether they are met."""
    shares = [share for numbers in results.values() for share in numbers["rows_right"].values()]
    text = f"At least {100 * min(shares):.2f} % of rows are right; asked: {100 * ROWS_RIGHT:.0f} %."
    said = [Statement("Contact detection", min(shares) >= ROWS_RIGHT, text)]
    surface = [numbers["surface"] for numbers in results.values()]
    offset, tilt = (max(one[name] for one in surface) for name in ("offset_mm", "tilt_degrees"))
    text = f"Offset within {offset:.2f} mm, tilt within {tilt:.3f}°; asked: {OFFSET_MM} mm, {TILT_DEGREES}°."
    said.append(Statement("Surface", offset <= OFFSET_MM and tilt <= TILT_DEGREES, text))
    for scene, numbers in results.items():
        for variant in ("torques", "sensor"):
            said.append(_force_finding(f"{scene}, {NAMES[variant]}", numbers[variant]))
    return said


def _force_finding(topic: str, score: dict[str, Any]) -> Statement:
    low, high = COVERAGE
    agrees = (
        abs(score["bias"]) <= BIAS
        and score["spread"] <= SPREAD
        and score["correlation"] >= CORRELATION
        and low <= score["coverage"] <= high
    )
    text = (
        f"λ less MuJoCo's force is {score['bias']:+.2f} ± {score['spread']:.2f} N with correlation "
        f"{score['correlation']:.3f}; ±2σ hold {100 * score['coverage']:.0f} %. Asked: {BIAS} ± {SPREAD} N, "
        f"{CORRELATION}, {100 * low:.0f} to {100 * high:.0f} %."
    )
    return Statement(topic, agrees, text)


@torch.no_grad()
def _block(line: real_contact.Line) -> report.PictureBlock:
    """Return λ over the first held-out stretch, by the fitted models."""
    system = load_scene(line.scene).system()
    data, truth = (
        Dataset.read(line.log.folder / real_contact.LOG),
        Dataset.read(line.run.folder / real_contact.RUN),
    )
    _, test = selected(data, truth, system)
    test = test[: min(SHOWN, _first_stretch(test.t))]
    contact = system.contact_names[0]
    force, closed = test.contact_extras["multiplier"][contact], test.contact[contact]
    bands = []
    for variant in ("torques", "sensor"):
        found = real_contact.force_of(line.fits[variant], test)
        bands.append(MultiplierBand.of(NAMES[variant], *found, force, closed, torch.zeros_like(closed)))
    t = test.t - test.t[0]  # of seconds since 1970, a series would keep too few digits
    open_spans = spans(t, ~closed)
    zero = report.series(torch.zeros_like(force))
    drawn = MultiplierData(
        t=report.series(t), c=zero, simulated=report.series(force), held_out=open_spans, bands=bands
    )
    caption = (
        f"Normal force in {line.scene} on the first held-out stretch; the contact is open where it is shaded."
    )
    return report.PictureBlock(
        line.scene, caption, tuple(draw_multiplier(drawn, b) for b in bands), "results.json"
    )


def _first_stretch(t: torch.Tensor) -> int:
    """Return the number of samples up to the first gap, ignoring the short gaps left by impacts."""
    gaps = (t.diff() > GAP).nonzero()[:, 0]
    return int(gaps[0]) + 1 if len(gaps) else len(t)
