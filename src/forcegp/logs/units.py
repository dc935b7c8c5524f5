"""Units of logs, as factors to SI and radians."""

from __future__ import annotations

import math
from collections.abc import Mapping

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

_SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millis": "ms",
    "milliseconds": "ms", "usec": "us", "micros": "us", "microseconds": "us", "nsec": "ns",
    "nanoseconds": "ns", "nanos": "ns", "µs": "us", "radian": "rad", "radians": "rad", "degree": "deg",
    "degrees": "deg", "°": "deg", "turn": "rev", "rev/min": "rpm", "1/min": "rpm", "°/s": "deg/s",
    "dps": "deg/s", "degps": "deg/s", "radps": "rad/s", "rads": "rad/s", "degs": "deg/s",
    "rad/sec": "rad/s", "deg/sec": "deg/s", "rad/s^2": "rad/s2", "rad/s²": "rad/s2",
    "deg/s^2": "deg/s2", "deg/s²": "deg/s2", "°/s²": "deg/s2", "°/s^2": "deg/s2", "n": "N",
    "m/s^2": "m/s2", "m/s²": "m/s2", "n m": "Nm", "n*m": "Nm", "n·m": "Nm", "nm": "Nm", "n.m": "Nm",
    "mnm": "mNm", "ncm": "Ncm", "kn": "kN", "knm": "kNm", "amp": "A", "amps": "A", "ampere": "A",
    "a": "A", "ma": "mA", "amperes": "A", "milliampere": "mA",
}  # fmt: skip


def spelled(text: str) -> str | None:
    """The canonical name of a unit in common notation, or `None` if it is unknown.

    >>> spelled("[deg/sec]"), spelled("Seconds"), spelled("furlong")
    ('deg/s', 's', None)
    """
    plain = text.strip().strip("[](){} ").strip()
    names = {name for table in QUANTITY.values() for name in table}
    if plain in names:
        return plain
    low = plain.lower()
    return low if low in names else _SPELLINGS.get(low)
