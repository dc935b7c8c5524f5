"""Findings with rows, severity and remedy, their report, and `KINDS` of them with meaning and remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from forcegp.errors import check_name
from forcegp.rows import Intervals, describe, intervals

Severity = Literal["note", "warning", "error"]


@dataclass(frozen=True)
class Kind:
    """A kind of finding: its part of the log, usual severity, title and remedy."""

    family: str
    severity: Severity
    title: str
    remedy: str


_TABLE: dict[str, tuple[tuple[str, Severity, str, str], ...]] = {
    "clock": (
        ("time-repeated", "error", "repeated time stamps", "drop the duplicate rows"),
        ("time-backward", "error", "time runs backward", "sort by time, or start a new segment there"),
        ("time-gap", "warning", "samples are missing", "start a new segment after each gap"),
        ("time-jitter", "warning", "uneven sampling", "resample the log to an even period"),
        ("time-unit", "error", "time is not in seconds", "convert the time column to seconds"),
        ("time-scale", "error", "the clock runs at another rate", "correct the sampling period"),
        ("period-header", "warning", "the header states another period", "correct `dt` in the header"),
    ),
    "values": (
        ("not-finite", "error", "NaN or infinite values", "drop these rows, or start a new segment"),
        ("rows-held", "warning", "rows that repeat the previous one", "drop the held rows"),
        ("channel-stuck", "error", "a channel stands still", "drop the interval; check the sensor"),
        ("torque-saturated", "warning", "torque at its limit", "mask these rows, or reduce the motion"),
        ("position-limit", "warning", "position limit exceeded", "check units, zero and joint order"),
        ("velocity-limit", "warning", "velocity limit exceeded", "check the units of the velocity"),
        ("torque-limit", "warning", "torque limit exceeded", "check units and gear ratio"),
        ("degrees", "error", "degrees instead of radians", "multiply the named columns by π/180"),
        ("quantised", "note", "coarse resolution", "smooth before differentiating; log filtered values"),
        ("spike", "warning", "isolated outliers", "drop or interpolate these rows"),
        ("position-jump", "error", "the position jumps", "start a new segment at each jump"),
        ("impact", "note", "the velocity jumps", "mask the rows around the impact"),
    ),
    "torque": (
        ("torque-zero", "error", "no torque is logged", "log the motor torque, or use another column"),
        ("torque-sign", "error", "wrong torque sign", "change the sign of the named torques"),
        ("torque-gain", "warning", "torque scaled wrongly", "correct gear ratio or motor constant"),
        ("torque-current", "error", "current instead of torque", "multiply by motor constant and gear"),
        ("torque-offset", "warning", "torque sensor offset", "subtract the offset, or learn a constant"),
        ("torque-delay", "warning", "torque and motion are not in step", "shift the torque in time"),
        ("torque-without-gravity", "error", "torque lacks gravity", "add the gravity torque back"),
        ("torque-order", "error", "torque columns are permuted", "match torque columns by joint name"),
    ),
    "kinematics": (
        ("velocity-mismatch", "error", "qd is not the derivative of q", "recompute qd from q"),
        ("velocity-sign", "error", "wrong velocity sign", "change the sign of the named velocities"),
        ("velocity-order", "error", "velocity columns are permuted", "match columns by joint name"),
        ("acceleration-mismatch", "error", "qdd is not the derivative of qd", "recompute qdd"),
        ("filter-wide", "warning", "the filter of a derivative is too wide", "import with a narrower window"),
        ("joint-order", "error", "joints are permuted", "match columns to joints by name"),
        ("joint-sign", "error", "joint turns the other way", "change the sign of all its columns"),
        ("encoder-offset", "warning", "encoder offset", "add the stated offset to q"),
    ),
    "mechanics": (
        ("gravity-direction", "error", "gravity points elsewhere", "correct gravity or base_rpy"),
        ("base-tilted", "warning", "the base is tilted", "correct `base_rpy` in the scene"),
        ("friction-undeclared", "warning", "undeclared joint friction", "learn joint friction"),
        ("masses-mismatch", "warning", "inertial parameters do not fit", "identify them from the log"),
        ("payload-missing", "warning", "a tool or payload is missing", "add it to the robot file"),
        ("torque-unexplained", "error", "the model explains too little", "check robot file and scene"),
        ("disturbance", "warning", "unmodelled torque for a while", "label the contact, or mask it"),
        ("robot-mismatch", "warning", "logged on another robot", "use the scene of that robot"),
    ),
    "import": (
        (
            "import-doubt",
            "warning",
            "the mapping was not checked",
            "correct or delete its lines marked CHECK",
        ),
        ("import-found", "note", "found at import", "see the import's report"),
    ),
    "contact": (
        ("contact-unlabelled", "error", "contact state is not logged", "add a contact column"),
        ("surface-offset", "warning", "the surface is displaced", "move the surface in the scene"),
        ("surface-tilted", "warning", "the surface is tilted", "correct the normal in the scene"),
        ("contact-early", "warning", "contact is labelled too early", "start the label later"),
        ("contact-late", "warning", "contact is labelled for too long", "end the label earlier"),
        ("contact-far", "error", "in contact far from the surface", "check surface, point and label"),
        ("contact-missed", "warning", "contact is not labelled", "label these rows as contact"),
        ("contact-pulls", "error", "the surface pulls", "reverse the surface normal"),
        ("contact-friction", "note", "friction at the contact", "add a contact friction prior"),
    ),
    "noise": (
        ("noise-understated", "warning", "more noise than stated", "raise noise_std, or learn it"),
        ("noise-overstated", "warning", "less noise than stated", "lower noise_std, or learn it"),
        ("noise-filtered", "warning", "filtered data, not white noise", "downsample; learn the noise"),
    ),
    "excitation": (
        ("log-short", "warning", "too few rows", "record a longer log"),
        ("joint-still", "warning", "a joint does not move", "move it: `forcegp excite` plans how"),
        ("few-reversals", "note", "few changes of direction", "reverse each joint several times"),
        ("poor-excitation", "note", "parameters not identified", "record what `forcegp excite` plans"),
        ("faults-hidden", "note", "faults too small to be seen", "move these joints more"),
        ("force-directions", "warning", "one sliding direction", "slide in several directions"),
    ),
}

KINDS: dict[str, Kind] = {
    name: Kind(family, severity, title, remedy)
    for family, rows in _TABLE.items()
    for name, severity, title, remedy in rows
}
"""Every kind of finding by name, family by family."""


SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""From the gravest to the lightest."""


@dataclass(frozen=True)
class Finding:
    """A fault or property that a check found in a log.

    Args:
        kind: one of `KINDS`.
        message: one sentence with the numbers.
        intervals: rows concerned, half-open and increasing, counted from 0.
        joints: the joints concerned.
        contact: the contact concerned, if any.
        evidence: the numbers behind the message, by name.
        weight: severity, if it differs from that of the kind.
        alternatives: other explanations that fit the log equally well.
        told_apart_by: a test that distinguishes them.

    Raises:
        UnknownNameError: no such kind.
    """

    kind: str
    message: str
    intervals: Intervals
    joints: tuple[str, ...] = ()
    contact: str | None = None
    evidence: Mapping[str, SupportsFloat] = field(default_factory=dict)
    weight: Severity | None = None
    alternatives: tuple[Finding, ...] = ()
    told_apart_by: str | None = None

    def __post_init__(self) -> None:
        check_name("kind of finding", self.kind, KINDS)

    @property
    def severity(self) -> Severity:
        """`"error"` makes a fit worthless, `"warning"` biases it, `"note"` is worth knowing.

        A finding with alternatives takes their lowest severity.
        """
        weight: Severity = self.weight or KINDS[self.kind].severity
        every = {weight, *(other.severity for other in self.alternatives)}
        return next(severity for severity in reversed(SEVERITIES) if severity in every)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Its kind and those of its alternatives, each once."""
        return tuple(dict.fromkeys((self.kind, *(other.kind for other in self.alternatives))))

    @property
    def remedy(self) -> str:
        """The remedy; with alternatives, the test that distinguishes them and the remedy of each."""
        if not self.alternatives:
            return KINDS[self.kind].remedy
        each = "; ".join(f"{kind}: {KINDS[kind].remedy}" for kind in self.kinds)
        return f"{self.told_apart_by}; then {each}" if self.told_apart_by else each

    @property
    def rows(self) -> int:
        """Number of rows concerned."""
        return sum(stop - start for start, stop in self.intervals)

    def to_dict(self) -> dict[str, Any]:
        """The finding as JSON-compatible values."""
        plain = ("kind", "severity", "message", "remedy", "contact", "told_apart_by")
        return {name: getattr(self, name) for name in plain} | {
            "kinds": list(self.kinds),
            "intervals": [list(interval) for interval in self.intervals],
            "joints": list(self.joints),
            "evidence": {name: float(value) for name, value in self.evidence.items()},
            "alternatives": [other.to_dict() for other in self.alternatives],
        }


def at_rows(
    mask: NDArray[np.bool_], kind: str, text: str, joints: tuple[str, ...] = (), **evidence: SupportsFloat
) -> list[Finding]:
    """A finding on the rows of a mask, appended to its text; empty if the mask has no row."""
    rows = intervals(mask)
    return [Finding(kind, f"{text} {describe(rows)}", rows, joints, evidence=evidence)] if rows else []


class NotJudgedError(Exception):
    """A check that cannot be made on this log; `Report.skipped` contains the message."""


@dataclass(frozen=True)
class Report:
    """All findings on a log, the most severe first, and the checks that were skipped, with the reason."""

    findings: tuple[Finding, ...]
    samples: int
    joint_names: tuple[str, ...]
    skipped: Mapping[str, str] = field(default_factory=dict)

    def count(self, severity: Severity) -> int:
        """Number of findings of a severity."""
        return sum(finding.severity == severity for finding in self.findings)

    @property
    def usable(self) -> bool:
        """Whether a model can be fitted to the log."""
        return self.count("error") == 0

    @property
    def verdict(self) -> str:
        """One line on whether a model can be fitted."""
        errors, warnings = self.count("error"), self.count("warning")
        if errors:
            return f"verdict: stop; repair {errors} error{'s' * (errors > 1)} before fitting a model"
        if warnings:
            return f"verdict: go on with care; {warnings} warning{'s' * (warnings > 1)} to look at"
        return "verdict: go on"

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON-compatible values."""
        return {
            "samples": self.samples,
            "joint_names": list(self.joint_names),
            "usable": self.usable,
            "verdict": self.verdict,
            "findings": [finding.to_dict() for finding in self.findings],
            "skipped": dict(self.skipped),
        }
