"""Plots of data sets, predictions, models and rollouts over time, drawn with matplotlib.

Panels share a time axis. They contain curves, bands of ±2 standard deviations, and shading during contact.
Segments are plotted one after the other, with gaps between them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forcegp.errors import ParameterError, check_name

if TYPE_CHECKING:  # matplotlib loads for 0.3 s
    from matplotlib.axes import Axes

MEASURED = "#222222"
PREDICTED = "#0072b2"
CONTACT = "#f5eed6"
"""Colour of the shading during contact."""
CYCLE = ("#0072b2", "#d55e00", "#007a5e", "#c4488c", "#6a3d9a", "#d08c00", "#555555")
"""Colours of the joints, which are reused if there are more joints."""
SYMBOLS = {
    "q": "q",
    "qd": r"\dot{q}",
    "qdd": r"\ddot{q}",
    "tau": r"\tau",
    "qdd_free": r"\ddot{q}'",
    "multiplier": r"\lambda",
    "constraint_force": "Q_I",
    "contact_force": "F_I",
    "total_force": r"\bar{Q}",
    "joint_force": "Q",
    "contact_friction": "Q_z",
    "c": "c",
    "cd": r"\dot{c}",
}
"""Symbols of quantities in the library's notation, as matplotlib math text."""
POWERS = {"q": "", "qd": "/s", "qdd": "/s²", "qdd_free": "/s²"}
CARTESIAN = {"multiplier": "N", "contact_force": "N", "c": "m", "cd": "m/s"}


def unit(quantity: str, kinds: Sequence[str] = ()) -> str:
    """Return the unit of a quantity in `SYMBOLS`, without brackets; "" if the quantity is unknown.

    If the types of the plotted joints (`"revolute"` or `"prismatic"`) are not given, both units are returned.

    Example:
        >>> unit("qdd", ["revolute"]), unit("tau"), unit("multiplier")
        ('rad/s²', 'N m, N', 'N')
    """
    if quantity in CARTESIAN:
        return CARTESIAN[quantity]
    if quantity not in SYMBOLS:
        return ""
    power = POWERS.get(quantity)
    turning, sliding = ("N m", "N") if power is None else (f"rad{power}", f"m{power}")
    units = {"revolute": turning, "prismatic": sliding}
    return ", ".join(text for kind, text in units.items() if not kinds or kind in kinds)


def axis_label(quantity: str, kinds: Sequence[str] = (), symbol: str | None = None) -> str:
    """Return the axis label of a quantity; `symbol` overrides the library's default symbol."""
    label = symbol or (f"${SYMBOLS[quantity]}$" if quantity in SYMBOLS else quantity)
    units = unit(quantity, kinds)
    return f"{label} [{units}]" if units else label


Array = NDArray[np.float64]
GAP = 3.0
"""Multiple of the median time step above which a step interrupts the curve."""


@dataclass(frozen=True)
class Timeline:
    """Positions of samples on the time axis.

    Attributes:
        x, order: `(n,)` positions in increasing order [s], and the row of the sample at each position.
        breaks: positions before which a curve is interrupted.
        ordered: whether the samples form a time series, which is drawn as a curve.
        label: label of the axis.
    """

    x: Array
    order: NDArray[np.int64]
    breaks: NDArray[np.int64]
    ordered: bool
    label: str

    @classmethod
    def of(cls, t: Tensor, segment: Tensor | None = None, ordered: bool = True) -> Timeline:
        """Place samples on the time axis. Overlapping segments are placed one after the other.

        Args:
            t: `(n,)` [s].
            segment: `(n,)` trajectory number of each sample; by default, there is one trajectory.
            ordered: whether the rows are in time order within each segment.
        """
        x, segments = as_array(t), np.zeros(len(t)) if segment is None else as_array(segment)
        order = np.arange(len(x)) if ordered else np.lexsort((x, segments))
        x, segments = x[order], segments[order]
        steps, changes = np.diff(x), np.diff(segments) != 0
        typical = float(np.median(steps[~changes])) if len(steps[~changes]) else 0.0
        joined = bool((steps[changes] <= 0).any())
        if joined:
            x = x + np.concatenate([[0.0], np.cumsum(np.where(changes, typical - steps, 0.0))])
        breaks = np.flatnonzero(changes | (steps > GAP * typical)) + 1
        label = "time, segments one after another [s]" if joined else "time [s]"
        return cls(x, order, breaks, ordered, label)

    def place(self, values: Tensor) -> Array:
        """Sort values `(n, …)` by their position on the axis."""
        return as_array(values)[self.order]

    def open(self, values: Array) -> Array:
        """Insert NaN at interruptions in values `(n,)` that are sorted by their position on the axis."""
        return np.insert(values, self.breaks, np.nan)

    def spans(self, closed: Tensor) -> list[tuple[float, float]]:
        """Return the time intervals in which a flag `(n,)` is true; none if samples are not a time series."""
        flags = as_array(closed)[self.order] > 0
        if not self.ordered or not len(flags):
            return []
        cuts = np.unique(np.concatenate([[0], np.flatnonzero(np.diff(flags)) + 1, self.breaks, [len(flags)]]))
        pairs = zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)
        return [(float(self.x[a]), float(self.x[b - 1])) for a, b in pairs if flags[a]]


def as_array(values: Any) -> Array:
    """Convert a tensor on any device to a double-precision array."""
    return torch.as_tensor(values).detach().to("cpu", torch.float64).numpy()


Target: TypeAlias = "Axes | Iterable[Axes] | None"
"""Axes to draw on, one per panel; `None` creates a new figure."""
WIDTH, ROW, MARGIN = 7.0, 1.25, 0.9
"""Width, height per panel, and margin of a new figure [inch]."""


@dataclass(frozen=True)
class Curve:
    """Values over time `(n,)`, their standard deviation (drawn as a ±2σ band), and the line `width` [pt]."""

    values: Tensor
    label: str
    colour: str
    std: Tensor | None = None
    width: float = 1.1


@dataclass(frozen=True)
class Panel:
    """A plot with its title, axis label and curves."""

    title: str
    ylabel: str
    curves: Sequence[Curve]


def draw_panels(
    panels: Sequence[Panel], time: Timeline, closed: Sequence[Tensor] = (), ax: Target = None
) -> list[Axes]:
    """Draw panels from top to bottom on the axes `ax` (by default, in a new figure), and return their axes.

    Shading marks intervals in which any contact is `closed` (given by flags `(n,)` for each contact).

    Raises:
        ParameterError: the number of axes is wrong.
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
    axes = list(np.asarray(ax, dtype=object).ravel())
    if len(axes) != count:
        text = "the number of axes differs from the number of panels"
        hint = "pass ax=None for a new figure, or choose joints"
        raise ParameterError(text, expected=f"{count} axes, one per panel", got=len(axes), hint=hint)
    return axes


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
    """Return the indices of the wanted names (all by default); raise `UnknownNameError` for unknown names."""
    for name in wanted or ():
        check_name(kind, name, names)
    return [list(names).index(name) for name in (names if wanted is None else wanted)]
