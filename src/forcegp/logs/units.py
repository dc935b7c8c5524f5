"""Units that a log may be in, as factors to SI and radians."""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib.resources import files

from forcegp.scene.document import tomllib

DEG = math.pi / 180.0
RPM = 2.0 * math.pi / 60.0

TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
POSITION = {"rad": 1.0, "mrad": 1e-3, "deg": DEG, "rev": 2.0 * math.pi, "m": 1.0, "mm": 1e-3}
VELOCITY = {
    "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": DEG, "rev/s": 2.0 * math.pi, "rpm": RPM, "m/s": 1.0, "mm/s": 1e-3,
}  # fmt: skip
ACCELERATION = {
    "rad/s2": 1.0, "deg/s2": DEG, "rev/s2": 2.0 * math.pi, "m/s2": 1.0, "mm/s2": 1e-3,
}  # fmt: skip
TORQUE = {"Nm": 1.0, "mNm": 1e-3, "Ncm": 1e-2, "kNm": 1e3, "N": 1.0, "kN": 1e3}
CURRENT = {"A": 1.0, "mA": 1e-3}
FORCE = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "kgf": 9.80665}

QUANTITY: Mapping[str, Mapping[str, float]] = {
    "time": TIME,
    "position": POSITION,
    "velocity": VELOCITY,
    "acceleration": ACCELERATION,
    "torque": {**TORQUE, **CURRENT},
    "force": FORCE,
    "moment": {name: TORQUE[name] for name in ("Nm", "mNm", "Ncm", "kNm")},
}
"""Units of each quantity of a mapping → factor to SI; currents are in ampere."""

SI = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s2", "torque": "Nm"}
"""Unit of each joint vector of a rotating joint that is assumed before any is known."""

VOCABULARY = tomllib.loads((files("forcegp.logs") / "vocabulary.toml").read_text(encoding="utf-8"))
"""Words of headings, and spellings of units."""
_SPELLINGS = {text: unit for unit, texts in VOCABULARY["spellings"].items() for text in texts}


def spelled(text: str) -> str | None:
    """The name in this file of a unit as people write it, or `None` where it is not known.

    >>> spelled("[deg/sec]"), spelled("Seconds"), spelled("furlong")
    ('deg/s', 's', None)
    """
    plain = text.strip().strip("[](){} ").strip()
    names = {name for table in QUANTITY.values() for name in table}
    if plain in names:
        return plain
    low = plain.lower()
    return low if low in names else _SPELLINGS.get(low)
