"""Plots of a data set: an overview of all joints, or one quantity for each joint or contact."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes

from forcegp.data.fields import AXES, JOINT_VECTORS, Fields
from forcegp.errors import UnknownNameError
from forcegp.plots import CYCLE, MEASURED, Curve, Panel, Target, Timeline, axis_label, chosen, draw_panels


def plot(
    data: Fields, quantity: str | None = None, joints: Sequence[str] | None = None, ax: Target = None
) -> list[Axes]:
    """Plot a data set. The arguments are those of `Dataset.plot`."""
    wanted = chosen(joints, data.joint_names, "joint of the data set")
    if quantity is None:
        panels = _overview(data, wanted)
    elif quantity in data.contact_extras:
        panels = _by_contact(data, quantity)
    elif quantity in (*JOINT_VECTORS, *data.extras):
        values, label = getattr(data, quantity), _named(quantity)
        curves = ((j, Curve(values[:, j], "logged", MEASURED, width=0.8)) for j in wanted)
        panels = [Panel(data.joint_names[j], label, [curve]) for j, curve in curves]
    else:
        names = (*JOINT_VECTORS, *data.extras, *data.contact_extras)
        raise UnknownNameError("quantity of the data set", quantity, names)
    time = Timeline.of(data.t, data.segment, data.header.ordered)
    return draw_panels(panels, time, tuple(data.contact.values()), ax)


def _overview(data: Fields, joints: list[int]) -> list[Panel]:
    panels = []
    for name in JOINT_VECTORS:
        values = getattr(data, name)
        curves = [Curve(values[:, j], data.joint_names[j], CYCLE[j % len(CYCLE)], width=0.8) for j in joints]
        panels.append(Panel("", _named(name), curves))
    multipliers = data.contact_extras.get("multiplier", {})
    if multipliers:
        curves = [Curve(x, name, CYCLE[i % len(CYCLE)]) for i, (name, x) in enumerate(multipliers.items())]
        panels.append(Panel("", _named("multiplier"), curves))
    return panels


def _by_contact(data: Fields, quantity: str) -> list[Panel]:
    panels = []
    for contact, values in data.contact_extras[quantity].items():
        parts = [values] if values.ndim == 1 else values.unbind(-1)
        names = ["logged"] if values.ndim == 1 else AXES
        curves = [Curve(x, name, CYCLE[i]) for i, (x, name) in enumerate(zip(parts, names, strict=True))]
        panels.append(Panel(contact, _named(quantity), curves))
    return panels


ALIASES = {"Q": "total_force", "Q_z": "contact_friction", "Q_I": "constraint_force", "F_I": "contact_force"}
"""Names of quantities, keyed by the symbol of the logged column."""


def _named(column: str) -> str:
    """Return the symbol and unit of a logged column."""
    base = column.removesuffix("_clean").removesuffix("_std").removesuffix("_logged")
    quantity = ALIASES.get(base, "contact_force" if base == "F_z" else base)
    return axis_label(quantity, (), None if column == quantity else column)
