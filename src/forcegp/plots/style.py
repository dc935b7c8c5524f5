"""Colours of plots over time, and what is written on their axes."""

from __future__ import annotations

from collections.abc import Sequence

MEASURED = "#222222"
PREDICTED = "#0072b2"
CONTACT = "#f5eed6"
"""Shade of the time in contact."""
CYCLE = ("#0072b2", "#d55e00", "#007a5e", "#c4488c", "#6a3d9a", "#d08c00", "#555555")
"""One colour per joint; joints beyond the last share them again."""
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
"""Quantities in the notation of the library, as mathematics."""
POWERS = {"q": "", "qd": "/s", "qdd": "/s²", "qdd_free": "/s²"}
CARTESIAN = {"multiplier": "N", "contact_force": "N", "c": "m", "cd": "m/s"}


def unit(quantity: str, kinds: Sequence[str] = ()) -> str:
    """The unit of a quantity of joints.

    Args:
        quantity: a name of `SYMBOLS`.
        kinds: `"revolute"` or `"prismatic"` for each joint on the axis; without them both units are given.

    Returns:
        The unit without brackets; empty for an unknown quantity.

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
    shown = {"revolute": turning, "prismatic": sliding}
    return ", ".join(text for kind, text in shown.items() if not kinds or kind in kinds)


def axis_label(quantity: str, kinds: Sequence[str] = (), symbol: str | None = None) -> str:
    """Symbol and unit of a quantity, for an axis; `symbol` replaces that of the library."""
    shown = symbol or (f"${SYMBOLS[quantity]}$" if quantity in SYMBOLS else quantity)
    known = unit(quantity, kinds)
    return f"{shown} [{known}]" if known else shown
