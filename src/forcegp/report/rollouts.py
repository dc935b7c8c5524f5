"""Trajectories beside the logged one: figures, table, and an animation that a person can watch."""

from __future__ import annotations

import base64
import hashlib
import json
from importlib.resources import files
from pathlib import Path

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.files import write_text
from forcegp.report.html import FigureBlock, render
from forcegp.report.rollout_data import ModelPath, RolloutData
from forcegp.report.style import INK, Picture, colour, draw, label
from forcegp.report.tables import Table

WIDTH = 4.6
PAGE, DATA = "rollout.html", "rollout.json"


def draw_tip(data: RolloutData) -> Picture:
    """Position of the tip over time by axis, logged and predicted, with bands over samples."""

    def paint(figure: Figure) -> None:
        for axis, axes in enumerate(figure.subplots(3, 1, sharex=True)):
            for path in data.models:
                t, shown = data.t[: len(path.tip[axis])], colour(path.model)
                if path.tip_bands:
                    band = path.tip_bands[axis]
                    axes.fill_between(
                        data.t[: len(band.lower)],
                        band.lower,
                        band.upper,
                        color=shown,
                        alpha=0.25,
                        linewidth=0,
                    )
                axes.plot(t, path.tip[axis], color=shown, label=label(path.model))
            axes.plot(data.t, data.tip[axis], color=INK, linestyle=(0, (4, 1.5)), label="simulated")
            span = max(data.tip[axis]) - min(data.tip[axis])
            middle = 0.5 * (max(data.tip[axis]) + min(data.tip[axis]))
            axes.set_ylim(middle - max(span, 0.02), middle + max(span, 0.02))
            axes.set_ylabel(f"{'xyz'[axis]} [m]")
            axes.margins(x=0.0)
        figure.axes[-1].set_xlabel("time [s]")
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)

    alt = f"Tip position over {data.t[-1]:.3g} s by axis, simulated and predicted in open loop by each model."
    return draw(paint, (WIDTH, 5.0), alt, "Position of the tip")


def draw_tip_error(data: RolloutData) -> Picture:
    """Distance between predicted and logged tip over time, on a logarithmic scale."""

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for path in data.models:
            error = [max(e, 1e-9) for e in path.tip_error]
            axes.plot(data.t[1 : len(error)], error[1:], color=colour(path.model), label=label(path.model))
        axes.set_yscale("log")
        axes.set_xlabel("time [s]")
        axes.set_ylabel("tip error [m]")
        axes.margins(x=0.0)
        figure.legend(loc="outside upper center", ncols=2)

    alt = f"Tip error over time, median over {data.starts} starts, on a logarithmic scale, one curve a model."
    return draw(paint, (WIDTH, 3.0), alt, "Tip error over time")


def draw_drift(data: RolloutData) -> Picture:
    """Constraint error of the predicted trajectories."""
    shown = [path for path in data.models if path.drift]

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        for path in shown:
            error = [max(abs(c), 1e-16) for c in path.drift]
            axes.plot(data.t[: len(error)], error, color=colour(path.model), label=label(path.model))
        axes.set_yscale("log")
        axes.set_xlabel("time [s]")
        axes.set_ylabel("|c(q)| [m]")
        axes.margins(x=0.0)
        figure.legend(loc="outside upper center", ncols=2)

    alt = (
        "Distance of the predicted tip from the surface over time, on a logarithmic scale, one curve a model."
    )
    return draw(paint, (WIDTH, 2.6), alt, "Drift off the surface")


def draw_contact_force(data: RolloutData) -> Picture:
    """The multiplier along predicted trajectories with its band, and the probability of lost contact."""
    shown = [path for path in data.models if path.multiplier]
    losing = [path for path in shown if path.lost]

    def paint(figure: Figure) -> None:
        panels = figure.subplots(2 if losing else 1, 1, sharex=True, squeeze=False)[:, 0]
        for path in shown:
            _paint_multiplier(panels[0], data, path)
        if data.multiplier:
            panels[0].plot(data.t, data.multiplier, color=INK, linestyle=(0, (4, 1.5)), label="simulated")
            top = max(data.multiplier)
            panels[0].set_ylim(min(0.0, min(data.multiplier)) - 0.2 * top, 1.6 * top)
        panels[0].set_ylabel("multiplier λ [N]")
        for path in losing:
            panels[1].plot(data.t[: len(path.lost)], path.lost, color=colour(path.model))
            panels[1].set_ylabel("P(contact lost)")
            panels[1].set_ylim(-0.03, 1.03)
        panels[-1].set_xlabel("time [s]")
        panels[-1].margins(x=0.0)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)

    alt = "Multiplier along the predicted trajectories, with bands over samples, beside the simulated one."
    return draw(paint, (WIDTH, 3.8 if losing else 2.8), alt, "Contact force along the way")


def _paint_multiplier(axes: Axes, data: RolloutData, path: ModelPath) -> None:
    band, shown = path.multiplier_band, colour(path.model)
    if band is not None:
        t = data.t[: len(band.lower)]
        axes.fill_between(t, band.lower, band.upper, color=shown, alpha=0.25, linewidth=0)
    axes.plot(data.t[: len(path.multiplier)], path.multiplier, color=shown, label=label(path.model))


def rollout_pictures(data: RolloutData) -> tuple[Picture, ...]:
    """All figures of the section that the data hold something for."""
    pictures = [draw_tip(data), draw_tip_error(data)]
    if any(path.drift for path in data.models):
        pictures.append(draw_drift(data))
    if any(path.multiplier for path in data.models):
        pictures.append(draw_contact_force(data))
    return tuple(pictures)


def rollout_table(data: RolloutData) -> Table:
    """Tip errors at the horizons, coverage of the bands and largest drift."""
    heads = ("model", *(f"after {h:g} s [mm]" for h in data.horizons), "in band", "largest drift [m]")
    rows = []
    for path in data.models:
        errors = ["diverged" if e is None else f"{1e3 * e:.3g}" for e in path.errors]
        coverage = "–" if path.coverage is None else f"{path.coverage:.3f}"
        drift = "–" if path.worst_drift is None else f"{path.worst_drift:.1e}"
        rows.append((label(path.model), *errors, coverage, drift))
    caption = f"Tip error in open loop (median over {data.starts} starts), and {data.level:.0%} bands"
    return Table(caption, heads, tuple(rows))


def animation(data: RolloutData) -> Markup:
    """The arm in motion: a canvas with a slider and a play button, drawn by a script of its own."""
    films = [
        {
            "label": "simulated" if film.label == "logged" else label(film.label),
            "colour": INK if film.label == "logged" else colour(film.label),
            "points": film.points,
        }
        for film in data.films
    ]
    content = {"times": data.frame_times, "bodies": data.bodies, "films": films}
    # "</" would end the script element, whatever it stands in.
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    return Markup(
        '<figure class="animation"><canvas width="920" height="560" role="img" '
        'aria-label="The arm moving: simulated in black, predicted in colour"></canvas>'
        '<p><button type="button">Play</button> <input type="range" min="0" value="0" step="1" '
        'aria-label="time"> <output></output></p>'
        f'<script type="application/json">{text}</script><script>{_script()}</script></figure>'
    )


def animation_source() -> str:
    """The animation's script as a page's content security policy names it: by its hash."""
    digest = hashlib.sha256(_script().encode()).digest()
    return "sha256-" + base64.b64encode(digest).decode()


def _script() -> str:
    return (files("forcegp.report") / "templates" / "animation.js").read_text(encoding="utf-8")


def rollout_block(data: RolloutData) -> FigureBlock:
    """The figures of the section under their caption."""
    band = f" with the band that holds {data.level:.0%} of the function samples" if _sampled(data) else ""
    return FigureBlock(
        "Trajectories predicted in open loop",
        f"From a logged state and the logged torques, {data.t[-1]:.3g} s ahead: simulated in black, "
        f"predicted in colour{band}. Errors are medians over {data.starts} starts. A curve ends where its "
        "prediction diverged.",
        rollout_pictures(data),
        DATA,
    )


def write_rollouts(folder: Path, title: str, data: RolloutData) -> Path:
    """Write the page on trajectories, its figures and their data.

    Args:
        folder: where the files go.
        title: models and data.
        data: what was predicted.

    Returns:
        The path of the page.
    """
    block = rollout_block(data)
    for i, picture in enumerate(block.pictures):
        write_text(folder / f"rollout-{i + 1}.svg", picture.svg)
    write_text(folder / DATA, data.to_json())
    text = render(
        "rollout.html.j2",
        title=title,
        table=rollout_table(data),
        blocks=(block,),
        animation=animation(data),
        script=animation_source(),
    )
    write_text(folder / PAGE, text)
    return folder / PAGE


def _sampled(data: RolloutData) -> bool:
    return any(path.tip_bands for path in data.models)
