"""Units used in logs, with conversion factors to SI units and radians."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files

from forcegp.scene.document import tomllib

VOCABULARY = tomllib.loads((files("forcegp.logs") / "vocabulary.toml").read_text(encoding="utf-8"))
"""Words used in headings, and spellings of units."""
_SPELLINGS = {text: unit for unit, texts in VOCABULARY["spellings"].items() for text in texts}
_UNITS: dict[str, dict[str, float]] = VOCABULARY["units"]
TIME, VELOCITY, TORQUE, CURRENT, FORCE = (
    _UNITS[name] for name in ("time", "velocity", "torque", "current", "force")
)
QUANTITY: Mapping[str, Mapping[str, float]] = {
    **_UNITS,
    "torque": {**TORQUE, **CURRENT},
    "servo": _UNITS["position"],
    "servo_velocity": VELOCITY,
    "servo_torque": TORQUE,
}
"""Factors that convert the units of each mapped quantity to SI units. Currents are converted to amperes."""
SI = {name: next(iter(_UNITS[name])) for name in ("position", "velocity", "acceleration", "torque")}
"""Default unit of each joint vector for revolute joints."""


def spelled(text: str) -> str | None:
    """Return the canonical name of a unit in common notation, or `None` if the unit is unknown.

    >>> spelled("[deg/sec]"), spelled("Seconds"), spelled("furlong")
    ('deg/s', 's', None)
    """
    plain = text.strip().strip("[](){} ").strip()
    names = {name for table in QUANTITY.values() for name in table}
    if plain in names:
        return plain
    low = plain.lower()
    return low if low in names else _SPELLINGS.get(low)
