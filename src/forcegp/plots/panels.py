"""Panels one above the other on a common time axis: curves, bands of ±2 standard deviations, contact."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from torch import Tensor

from forcegp.errors import ParameterError, UnknownNameError
from forcegp.plots.style import CONTACT
from forcegp.plots.timeline import Timeline

Target = Axes | Iterable[Axes] | None
"""Where to draw: axes of the caller, one per panel, or `None` for a new figure."""
WIDTH, ROW, MARGIN = 7.0, 1.25, 0.9
"""Size of a new figure [inch]."""


@dataclass(frozen=True)
class Curve:
    """Values over time.

    Attributes:
        values: `(n,)`.
        label: in the legend.
        colour: of the curve.
        std: `(n,)` standard deviation, drawn as a band of ±2.
        width: of the line [pt].
    """

    values: Tensor
    label: str
    colour: str
    std: Tensor | None = None
    width: float = 1.1


@dataclass(frozen=True)
class Panel:
    """One plot.

    Attributes:
        title: above it.
        ylabel: name and unit of its values.
        curves: what it shows.
    """

    title: str
    ylabel: str
    curves: Sequence[Curve]


def draw_panels(
    panels: Sequence[Panel], time: Timeline, closed: Sequence[Tensor] = (), ax: Target = None
) -> list[Axes]:
    """Draw panels one above the other.

    Args:
        panels: from top to bottom.
        time: of the samples.
        closed: flags `(n,)` of contacts; the time in which any of them is closed is shaded.
        ax: axes to draw on, one per panel; default a new figure.

    Returns:
        The axes, one per panel.

    Raises:
        ParameterError: another number of axes is given.
    """
    axes = _axes(len(panels), ax)
    spans = time.spans(sum(flags.double() for flags in closed) > 0) if closed else []  # pyright: ignore
    for one, panel in zip(axes, panels, strict=True):
        for i, (first, last) in enumerate(spans):
            one.axvspan(first, last, color=CONTACT, zorder=0, linewidth=0, label="" if i else "in contact")
        for curve in panel.curves:
            _draw(one, curve, time)
        one.set_title(panel.title, loc="left", fontsize="medium")
        one.set_ylabel(panel.ylabel)
        one.margins(x=0.0)
    axes[-1].set_xlabel(time.label)
    handles, names = axes[0].get_legend_handles_labels()
    if len(names) > 1:
        axes[0].legend(handles, names, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, frameon=False)
    return axes


def _axes(count: int, ax: Target) -> list[Axes]:
    if ax is None:
        import matplotlib.pyplot as plt

        size = (WIDTH, MARGIN + ROW * max(count, 2))
        _, made = plt.subplots(count, 1, sharex=True, squeeze=False, figsize=size, layout="constrained")
        made[0, 0].figure.align_ylabels()
        return list(made[:, 0])
    given = [ax] if isinstance(ax, Axes) else list(np.asarray(ax, dtype=object).ravel())
    if len(given) != count:
        raise ParameterError(
            "the number of axes is not that of the panels",
            expected=f"{count} axes, one per panel",
            got=len(given),
            hint="pass ax=None for a new figure, or choose joints",
        )
    return given


def _draw(axes: Axes, curve: Curve, time: Timeline) -> None:
    values = time.place(curve.values)
    if not time.ordered:
        error = None if curve.std is None else 2.0 * time.place(curve.std)
        style: dict[str, Any] = {"color": curve.colour, "linestyle": "none", "marker": ".", "markersize": 4}
        axes.errorbar(time.x, values, yerr=error, elinewidth=0.6, label=curve.label, **style)
        return
    x, y = time.open(time.x), time.open(values)
    if curve.std is not None:
        spread = 2.0 * time.open(time.place(curve.std))
        axes.fill_between(x, y - spread, y + spread, color=curve.colour, alpha=0.25, linewidth=0, label="±2σ")
    axes.plot(x, y, color=curve.colour, linewidth=curve.width, label=curve.label)


def chosen(wanted: Sequence[str] | None, names: Sequence[str], kind: str) -> list[int]:
    """Indices of the wanted names, by default all of them.

    Raises:
        UnknownNameError: a name does not exist.
    """
    for name in wanted or ():
        if name not in names:
            raise UnknownNameError(kind, name, names)
    return [list(names).index(name) for name in (names if wanted is None else wanted)]
