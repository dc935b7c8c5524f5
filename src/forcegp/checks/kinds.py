"""The kinds of finding: how grave each is, what it means and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["note", "warning", "error"]


@dataclass(frozen=True)
class Kind:
    """A kind of finding.

    Attributes:
        family: which part of the log it concerns.
        severity: its weight unless a finding says otherwise.
        title: in a few words.
        remedy: what to do about it.
    """

    family: str
    severity: Severity
    title: str
    remedy: str


_TABLE: tuple[tuple[str, str, Severity, str, str], ...] = (
    # clock
    ("time-repeated", "clock", "error", "repeated time stamps", "drop the duplicate rows"),
    ("time-backward", "clock", "error", "time runs backward", "sort by time, or start a new segment there"),
    ("time-gap", "clock", "warning", "samples are missing", "start a new segment after each gap"),
    ("time-jitter", "clock", "warning", "uneven sampling", "resample the log to an even period"),
    ("time-unit", "clock", "error", "time is not in seconds", "convert the time column to seconds"),
    ("time-scale", "clock", "error", "the clock runs at another rate", "correct the sampling period"),
    ("period-header", "clock", "warning", "the header states another period", "correct `dt` in the header"),
    # values
    ("not-finite", "values", "error", "NaN or infinite values", "drop these rows, or start a new segment"),
    ("rows-held", "values", "warning", "rows that repeat the previous one", "drop the held rows"),
    ("channel-stuck", "values", "error", "a channel stands still", "drop the interval; check the sensor"),
    ("torque-saturated", "values", "warning", "torque at its limit", "mask these rows, or reduce the motion"),
    ("position-limit", "values", "warning", "position limit exceeded", "check units, zero and joint order"),
    ("velocity-limit", "values", "warning", "velocity limit exceeded", "check the units of the velocity"),
    ("torque-limit", "values", "warning", "torque limit exceeded", "check units and gear ratio"),
    ("degrees", "values", "error", "degrees instead of radians", "multiply the named columns by π/180"),
    (
        "quantised",
        "values",
        "note",
        "coarse resolution",
        "smooth before differentiating; log filtered values",
    ),
    ("spike", "values", "warning", "isolated outliers", "drop or interpolate these rows"),
    ("position-jump", "values", "error", "the position jumps", "start a new segment at each jump"),
    ("impact", "values", "note", "the velocity jumps", "mask the rows around the impact"),
    # torque
    ("torque-zero", "torque", "error", "no torque is logged", "log the motor torque, or use another column"),
    ("torque-sign", "torque", "error", "wrong torque sign", "change the sign of the named torques"),
    ("torque-gain", "torque", "warning", "torque scaled wrongly", "correct gear ratio or motor constant"),
    ("torque-current", "torque", "error", "current instead of torque", "multiply by motor constant and gear"),
    (
        "torque-offset",
        "torque",
        "warning",
        "torque sensor offset",
        "subtract the offset, or learn a constant",
    ),
    ("torque-delay", "torque", "warning", "torque and motion are not in step", "shift the torque in time"),
    ("torque-without-gravity", "torque", "error", "torque lacks gravity", "add the gravity torque back"),
    ("torque-order", "torque", "error", "torque columns are permuted", "match torque columns by joint name"),
    # kinematics
    ("velocity-mismatch", "kinematics", "error", "qd is not the derivative of q", "recompute qd from q"),
    (
        "velocity-sign",
        "kinematics",
        "error",
        "wrong velocity sign",
        "change the sign of the named velocities",
    ),
    ("velocity-order", "kinematics", "error", "velocity columns are permuted", "match columns by joint name"),
    ("acceleration-mismatch", "kinematics", "error", "qdd is not the derivative of qd", "recompute qdd"),
    ("joint-order", "kinematics", "error", "joints are permuted", "match columns to joints by name"),
    ("joint-sign", "kinematics", "error", "joint turns the other way", "change the sign of all its columns"),
    ("encoder-offset", "kinematics", "warning", "encoder offset", "add the stated offset to q"),
    # mechanics
    ("gravity-direction", "mechanics", "error", "gravity points elsewhere", "correct gravity or base_rpy"),
    ("base-tilted", "mechanics", "warning", "the base is tilted", "correct `base_rpy` in the scene"),
    ("friction-undeclared", "mechanics", "warning", "undeclared joint friction", "learn joint friction"),
    (
        "masses-mismatch",
        "mechanics",
        "warning",
        "inertial parameters do not fit",
        "identify them from the log",
    ),
    ("payload-missing", "mechanics", "warning", "a tool or payload is missing", "add it to the robot file"),
    (
        "torque-unexplained",
        "mechanics",
        "error",
        "the model explains too little",
        "check robot file and scene",
    ),
    (
        "disturbance",
        "mechanics",
        "warning",
        "unmodelled torque for a while",
        "label the contact, or mask it",
    ),
    ("robot-mismatch", "mechanics", "warning", "logged on another robot", "use the scene of that robot"),
    # contact
    ("contact-unlabelled", "contact", "error", "contact state is not logged", "add a contact column"),
    ("surface-offset", "contact", "warning", "the surface is displaced", "move the surface in the scene"),
    ("surface-tilted", "contact", "warning", "the surface is tilted", "correct the normal in the scene"),
    ("contact-early", "contact", "warning", "contact is labelled too early", "start the label later"),
    ("contact-late", "contact", "warning", "contact is labelled for too long", "end the label earlier"),
    ("contact-far", "contact", "error", "in contact far from the surface", "check surface, point and label"),
    ("contact-missed", "contact", "warning", "contact is not labelled", "label these rows as contact"),
    ("contact-pulls", "contact", "error", "the surface pulls", "reverse the surface normal"),
    ("contact-friction", "contact", "note", "friction at the contact", "add a contact friction prior"),
    # noise
    ("noise-understated", "noise", "warning", "more noise than stated", "raise noise_std, or learn it"),
    ("noise-overstated", "noise", "warning", "less noise than stated", "lower noise_std, or learn it"),
    (
        "noise-filtered",
        "noise",
        "warning",
        "filtered data, not white noise",
        "downsample; learn the noise",
    ),
    # excitation
    ("log-short", "excitation", "warning", "too few rows", "record a longer log"),
    ("joint-still", "excitation", "warning", "a joint does not move", "move the joint through its range"),
    ("few-reversals", "excitation", "note", "few changes of direction", "reverse each joint several times"),
    ("poor-excitation", "excitation", "note", "parameters not identified", "add the motion stated"),
    ("faults-hidden", "excitation", "note", "faults too small to be seen", "move these joints more"),
    ("force-directions", "excitation", "warning", "one sliding direction", "slide in several directions"),
)

KINDS: dict[str, Kind] = {row[0]: Kind(*row[1:]) for row in _TABLE}
"""Every kind of finding by name, family by family."""
