"""Page on an evaluated model: the verdict, errors by joint, calibration, and predictions over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from forcegp.evaluation import Evaluation
from forcegp.evaluation.scores import JointErrors
from forcegp.files import write_text
from forcegp.models.fit_result import Compared
from forcegp.report.page import INK, NAMES, Picture, PictureBlock, Table, cell, colour, draw, label, render
from forcegp.report.window import WindowData, draw_errors, draw_forces, draw_predictions

PAGE, WINDOW = "evaluation.html", "window.json"
PLOTS = ("predictions.svg", "errors.svg", "calibration.svg")


def write_evaluation(
    folder: Path,
    model: str,
    data: str,
    fitted_to: str | None,
    scores: Evaluation,
    window: WindowData,
    comparison: Sequence[Compared] = (),
) -> Path:
    """Write the page on a model together with its plots and their data, and return the path of the page.

    `model`, `data` and `fitted_to` are file names shown on the page. If `fitted_to` is `None`, the trivial
    predictors were fitted to halves of the data. `comparison` contains the compared sets of force priors.
    """
    drawn = {"Predictions": draw_predictions(window), "Errors": draw_errors(window)}
    pictures = [dataclasses.replace(picture, title=title) for title, picture in drawn.items()]
    pictures += [draw_calibration(scores)] if scores.uncertainty else []
    force = draw_forces(window) if window.forces else None
    named = [*zip(PLOTS, pictures, strict=False), *([("forces.svg", force)] if force else [])]
    for name, picture in named:
        write_text(folder / name, picture.svg)
    write_text(folder / WINDOW, window.to_json())
    # The name `model` would add no information to the title.
    name = "" if Path(model).name.lower() in ("", "model") else f" “{Path(model).name}”"
    tables = *error_tables(scores), *uncertainty_tables(scores), score_table(scores)
    page = render(
        "evaluation.html.j2",
        title=f"{label(scores.kind)}{name} on {Path(data).name}",
        model=model,
        data=data,
        scores=scores,
        baseline_data=fitted_to or "the other half of the data",
        tables=(*tables, *comparison_tables(comparison)),
        blocks=_blocks(window, pictures, force),
    )
    write_text(folder / PAGE, page)
    return folder / PAGE


def _blocks(window: WindowData, pictures: list[Picture], force: Picture | None) -> list[PictureBlock]:
    caption = (
        "The normal force λ of the closed contact, over the same seconds, with ±2σ if the model gives it."
    )
    blocks = [PictureBlock("Contact force", caption, (force,), WINDOW, wide=True)] if force else []
    blocks += [
        PictureBlock(
            "Predictions and errors",
            f"The first {window.seconds:.2g} s. Predictions: accelerations by joint, measured in black, "
            "predicted in colour, with the ±2σ band if the model gives one. Errors: measured (grey) and, if "
            "logged, noise-free (black) acceleration minus the prediction.",
            tuple(pictures[:2]),
            WINDOW,
        )
    ]
    if len(pictures) > 2:
        caption = (
            "Fraction of measured accelerations inside the central interval of each probability. On the "
            "diagonal, the uncertainty is correct; below, the model is overconfident, above, underconfident."
        )
        blocks.append(PictureBlock("Calibration", caption, tuple(pictures[2:]), "evaluation.json"))
    return blocks


def draw_calibration(evaluation: Evaluation) -> Picture:
    """Plot the coverage against the nominal probability."""
    shares = evaluation.uncertainty.calibration if evaluation.uncertainty else {}
    levels = {float(level): share for level, share in shares.items()}

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot([0.4, 1.0], [0.4, 1.0], color=INK, linewidth=0.8, linestyle=":", label="nominal")
        axes.plot(list(levels), list(levels.values()), "o-", color=colour(evaluation.kind), label="model")
        axes.set_xlabel("probability of the interval")
        axes.set_ylabel("fraction of samples inside")
        axes.set_ylim(0.0, 1.02)
        figure.legend(loc="outside upper center", ncols=2)

    listed = ", ".join(f"{share:.2f} at {level:g}" for level, share in levels.items())
    alt = f"Calibration, fraction of samples inside: {listed}."
    return draw(paint, (4.1, 3.4), alt, label(evaluation.kind))


def error_tables(evaluation: Evaluation) -> tuple[Table, ...]:
    """Return tables of torque and acceleration errors by joint. Red means worse than a trivial predictor."""
    units = {"torque": "[N m, N]", "acceleration": "[rad/s², m/s²]"}
    tables = []
    for unit, names in units.items() if evaluation.predictors else ():
        errors: dict[str, JointErrors] = {p.name: getattr(p, unit) for p in evaluation.predictors}
        model_errors, *others = errors.values()
        head = ("joint", *errors, "model, at rest", "model, error / standard deviation")
        rows, bad = [], set()
        for i, joint in enumerate(evaluation.joint_names):
            shown = [e.in_motion[i] for e in errors.values()]
            values = (*shown, model_errors.rest[i], model_errors.normalised[i])
            rows.append((joint, *(cell(x, 3) for x in values)))
            if any((shown[0] or 0.0) > (e.in_motion[i] or 0.0) for e in others):
                bad.add((i, 1))
        caption = f"{unit.capitalize()} error in motion, root mean square {names}; red: not the lowest"
        tables.append(Table(caption, head, tuple(rows), frozenset(bad)))
    return tuple(tables)


def uncertainty_tables(evaluation: Evaluation) -> tuple[Table, ...]:
    """Return tables of coverage by joint, log densities of all predictors, and λ compared with the log."""
    tables = []
    if evaluation.uncertainty is not None:
        shares = zip(evaluation.joint_names, evaluation.uncertainty.coverage_by_joint, strict=True)
        rows = tuple((joint, f"{share:.3f}") for joint, share in shares)
        caption = "±2σ coverage of measured accelerations (nominal 0.954)"
        tables.append(Table(caption, ("joint", "share"), rows))
    if any(p.nlpd is not None for p in evaluation.predictors):
        rows = tuple((p.name, "–" if p.nlpd is None else f"{-p.nlpd:.3f}") for p in evaluation.predictors)
        caption = "Mean log density of a measured joint acceleration [nats], higher is better"
        tables.append(Table(caption, ("predictor", "log density"), rows))
    head = ("contact", "samples", "bias [N]", "standard deviation [N]", "correlation", "±2σ coverage")
    plain = "Multiplier λ: predicted minus logged"
    titles = plain, f"{plain}, with the force sensor"
    for title, scores in zip(titles, (evaluation.multipliers, evaluation.sensed), strict=True):
        values = [(m.contact, m.samples, m.bias, m.spread, m.correlation, m.coverage) for m in scores]
        if values:
            tables.append(Table(title, head, tuple(tuple(cell(x, 3) for x in row) for row in values)))
    return tuple(tables)


def score_table(evaluation: Evaluation) -> Table:
    """Return a table of the overall scores, with units."""
    scores = evaluation.summary()
    rows = tuple((name, cell(scores[k])) for k, name in NAMES["scores"].items() if scores[k] is not None)
    return Table("Scores over all joints", ("score", "value"), rows)


def comparison_tables(comparison: Sequence[Compared]) -> tuple[Table, ...]:
    """Return a table of the compared sets of force priors, or no table if the priors were given."""
    rows = tuple(
        tuple(cell(x, 3) for x in (each.name, each.log_density, each.behind, each.standard_error, note))
        for each in comparison
        for note in [", ".join(part for part in ("chosen" if each.chosen else "", each.note) if part)]
    )
    caption = "Force priors, compared on held-out blocks of the training log [nats per sample]"
    return (Table(caption, ("set", "log density", "behind", "standard error", ""), rows),) if rows else ()
