"""Checks that compare a log with a scene before a model is fitted, and the report of all checks."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from forcegp.checks import clock, contact, excitation, kinematics, limits, mechanics, placement, values
from forcegp.checks.finding import KINDS, SEVERITIES, Finding, NotJudgedError, Report
from forcegp.checks.limits import clipped_torques
from forcegp.checks.log import Log, Outcome, log_of, of_robot, read_log
from forcegp.constraints import ConstrainedSystem
from forcegp.data.dataset import Dataset
from forcegp.resources import announce_memory

__all__ = ["KINDS", "Finding", "Log", "Report", "check", "clipped_torques", "log_of", "read_log"]

NUMBERS = 24
"""Upper bound on the number of values held in memory per joint and row. About twenty were measured."""
OF_CONTACTS = frozenset({"contact", "contact force"})
"""Names of the checks that are skipped if there are no contacts."""
OF_TIME = frozenset(
    {
        *("time stamps", "order of time", "held rows", "gaps", "jitter", "sampling period", "lost rows"),
        "standing channels",
    }
)
"""Names of the checks that require the rows to be in time order."""
IMPORTED = {
    "doubt": "import-doubt",
    "faster than its source": "rows-held",
    "gap": "time-gap",
    "jitter": "time-jitter",
    "lost": "time-gap",
    "modelled": "torque-noiseless",
}
"""Kinds of findings made during import that are reported as a finding other than `import-found`."""
Check = Callable[[ConstrainedSystem, Log], Outcome]
Progress = Callable[[int, int], None]


def check_robot(system: ConstrainedSystem, log: Log) -> Outcome:
    """Compare the robot named in the header with the robot of the scene."""
    logged, robot = log.header, system.robot
    if logged.robot_fingerprint in (None, robot.fingerprint):
        return [], log
    if logged.robot == robot.name:
        text = f"the base, gravity or parameters of {robot.name!r} differ from those at import"
        return [log.finding("robot-changed", text)], log
    text = f"logged on robot {logged.robot!r} ({logged.robot_fingerprint}), and the scene has {robot.name!r}"
    return [log.finding("robot-mismatch", text)], log


def check_import(system: ConstrainedSystem, log: Log) -> Outcome:
    """Return the findings of the import, except those about contacts, which are checked separately."""
    texts: dict[str, list[str]] = {}
    for kind, text in log.header.imported:
        if kind != "contact":
            texts.setdefault(IMPORTED.get(kind, "import-found"), []).append(text)
    findings = [log.finding(kind, "; ".join(several)) for kind, several in texts.items()]
    # If most rows are repeated, the logger was faster than its source, and no derivative can be computed.
    return [replace(f, weight="error") if f.kind == "rows-held" else f for f in findings], log


CHECKS: tuple[tuple[str, Check], ...] = (
    ("finite values", values.check_finite),
    ("time stamps", clock.check_stamps),
    ("order of time", clock.check_order),
    ("robot", check_robot),
    ("import", check_import),
    ("held rows", values.check_held),
    ("gaps", clock.check_gaps),
    ("jitter", clock.check_jitter),
    ("degrees", limits.check_degrees),
    ("wrapped angles", values.check_wrapped),
    ("lost rows", clock.check_lost),
    ("unit of time", clock.check_clock_unit),
    ("sampling period", clock.check_period),
    ("spikes", values.check_spikes),
    ("standing channels", values.check_stuck),
    ("jumps", values.check_jumps),
    ("velocity", kinematics.check_velocity),
    ("acceleration", kinematics.check_acceleration),
    ("impacts", values.check_impacts),
    ("resolution", values.check_resolution),
    ("limits", limits.check_limits),
    ("saturation", limits.check_saturation),
    ("length", excitation.check_length),
    ("motion", excitation.check_motion),
    ("noise", kinematics.check_noise),
    ("placement of the tip", placement.check_placement),
    ("dynamics", mechanics.check_dynamics),
    ("contact", contact.check_contacts),
    ("contact force", contact.check_forces),
    ("excitation", excitation.check_excitation),
)
"""All checks in the order in which they run. Each receives the log as corrected by the previous ones."""

_MOTION = frozenset({"velocity-mismatch"})
_ROBOT = frozenset(
    {"gravity-direction", "base-tilted", "payload-missing", "masses-mismatch", "torque-unexplained"}
)
_RATES = (
    *(
        "unit of time",
        "sampling period",
        "spikes",
        "jumps",
        "velocity",
        "acceleration",
        "impacts",
        "resolution",
    ),
    *("noise", "length", "dynamics", "contact force", "excitation"),
)
VOIDS = {name: frozenset({"rows-lost"}) for name in _RATES}
VOIDS |= {name: VOIDS[name] | _MOTION for name in ("dynamics", "contact force", "excitation")}
VOIDS["contact force"] |= _ROBOT
"""For each check, the findings that invalidate its result."""


def check(system: ConstrainedSystem, data: Dataset | Log, *, progress: Progress | None = None) -> Report:
    """Check a log against a scene before fitting a model.

    A valid log yields no findings. Each fault is corrected in a copy of the log before the next check runs,
    so that it is reported only once.

    Args:
        system: the robot and its contacts.
        data: the log. Use `forcegp.checks.read_log` to read a log that `Dataset` rejects.
        progress: a function called with the number of completed checks and the total number of checks.

    Returns:
        A report of the findings, sorted by severity. Its attribute `usable` is true if a model can be fitted.

    Raises:
        DataError: a joint of the robot is missing from the log, or the log is empty.

    Example:
        >>> import forcegp
        >>> system = forcegp.load_scene("kuka_plane").system()
        >>> report = forcegp.check(system, forcegp.Dataset.read("run.parquet"))  # doctest: +SKIP
        >>> print(report.verdict)  # doctest: +SKIP
        verdict: go on
    """
    system = replace(system, robot=system.robot.to("cpu", torch.float64))
    log = of_robot(data if isinstance(data, Log) else log_of(data), system.robot)
    samples, findings, skipped = len(log), [], {}
    announce_memory(8 * NUMBERS * log.nq * samples, f"checking {samples:,} rows")
    for done, (name, run) in enumerate(CHECKS):
        if progress is not None:
            progress(done, len(CHECKS))
        if (name in OF_CONTACTS and not system.contacts) or (name in OF_TIME and not log.header.ordered):
            continue
        kinds = (kind for finding in findings for kind in finding.kinds)
        void = next((kind for kind in kinds if kind in VOIDS.get(name, ())), None)
        if void:
            skipped[name] = f"not judged after {void}"
            continue
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            try:
                faults, log = run(system, log)
            except NotJudgedError as reason:
                skipped[name], faults = str(reason), []
        findings += faults
        if not log.usable.any():
            text = "no row of the log is usable"
            findings.append(Finding("log-short", text, log.all_rows, weight="error"))
            skipped |= {other: "no row is usable" for other, _ in CHECKS[done + 1 :]}
            break
    order = list(KINDS)
    # Faults of torque and robot keep the order in which they were found, since the first explains most.
    first = {"torque": "torque-sign", "mechanics": "torque-sign", "learned": "torque-offset"}

    def rank(f: Finding) -> tuple[float, ...]:
        # Findings on a few rows follow those on the whole log. Effects that a fit learns are sorted by size.
        family = KINDS[f.kind].family
        isolated = family in ("clock", "values") and 2 * f.rows < samples
        # A filter that delays all velocities alike hides no other fault, and is named after them.
        place = len(order) if f.evidence.get("common") else order.index(first.get(family, f.kind))
        return SEVERITIES.index(f.severity), isolated, place, -float(f.evidence.get("largest_torque", 0.0))

    findings.sort(key=rank)
    return Report(tuple(findings), samples, system.robot.joint_names, skipped)
