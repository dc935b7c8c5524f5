"""Import of logs from other programs.

`read_log` reads a log file of any supported format as a data set for a robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from forcegp.constraints import ConstrainedSystem
from forcegp.data import DataHeader, Dataset
from forcegp.data.clipped import clipped
from forcegp.data.fields import recording_number
from forcegp.errors import DataError
from forcegp.guards import foreign
from forcegp.logs.base import add_imu
from forcegp.logs.clock import even_clock, usual_step
from forcegp.logs.compensated import restore
from forcegp.logs.contact import Evidence, detect, per_contact
from forcegp.logs.from_contact import derive_joints, stick_speeds
from forcegp.logs.gather import gather
from forcegp.logs.mapping import (
    Mapping,
    default_mapping,
    load_mapping,
    parse_mapping,
    scale_std,
    torque_constants,
)
from forcegp.logs.modelled import find_modelled, without_noise
from forcegp.logs.motion import check_base, check_clock, find_jumps
from forcegp.logs.servo import damp, servo_fields, spring_torque
from forcegp.logs.smoothing import add_derivatives, impact_mask
from forcegp.logs.table import Array, ImportFinding, ImportReport, Signals
from forcegp.resources import announce_memory
from forcegp.robot import RobotModel
from forcegp.scene import Scene, load_scene

__all__ = [
    "ImportFinding",
    "ImportReport",
    "Imported",
    "Mapping",
    "import_log",
    "load_mapping",
    "parse_mapping",
    "read_log",
]

NUMBERS = 16
"""Upper bound on the number of values held in memory per joint and row. Ten were measured."""
DIGITS = 6
"""Number of digits of a log's hash in the name of its recording."""


@dataclass(frozen=True)
class Imported:
    """An imported data set with the report of the import and the evidence for each detected contact."""

    data: Dataset
    report: ImportReport
    contacts: tuple[Evidence, ...] = ()


def read_log(
    path: str | Path,
    scene: Scene | ConstrainedSystem | RobotModel | str | Path,
    mapping: Mapping | str | Path | None = None,
) -> Dataset:
    """Read a log of any supported format as a data set for a robot.

    Args:
        path: the log file or folder.
        scene: a scene or the path of its file, a system, or a robot.
        mapping: a mapping of the columns, the path of its file, or the name of a bundled mapping. If it is
            omitted, columns must be named as in a data set or in ROS joint states.

    Returns:
        The log in SI units and in the robot's joint order.

    Raises:
        DataError: the log cannot be read or used. The message names the column and the rows.
        MappingError: the mapping is invalid or does not match the log.
        MissingDependencyError: the reader for the format is not installed.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "run.csv"
    >>> rows = "\\n".join(f"{k},{k / 10},0,{k / 5},0" for k in range(40))
    >>> _ = file.write_text("ms,a,b,Ta,Tb\\n" + rows)
    >>> from forcegp.logs import parse_mapping
    >>> toml = '''
    ... time = { column = "ms", unit = "ms" }
    ... joints = { shoulder = "a", elbow = "b" }
    ... position = { column = "{joint}", unit = "deg" }
    ... torque = { column = "T{joint}", unit = "Nm" }
    ... '''
    >>> import forcegp
    >>> robot = forcegp.load_robot("double_pendulum")
    >>> data = read_log(file, robot, parse_mapping(toml.encode(), "mapping"))
    >>> round(float(data.qd[20, 0]), 3)  # 0.1 degrees per millisecond
    1.745
    """
    return import_log(path, scene, mapping).data


def import_log(
    path: str | Path,
    scene: Scene | ConstrainedSystem | RobotModel | str | Path,
    mapping: Mapping | str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    displaced: bool = False,
) -> Imported:
    """Read a log as in `read_log`, and report the import. If `displaced`, accept a displaced surface."""
    system = system_of(scene)
    log_mapping = default_mapping(path, system) if mapping is None else mapping
    log_mapping = log_mapping if isinstance(log_mapping, Mapping) else load_mapping(log_mapping)
    report = ImportReport(str(path))
    report.steps.append(f"read {Path(path).name} by mapping {Path(log_mapping.document.source).name}")
    for doubt in log_mapping.doubts:
        report.find("doubt", doubt)
    try:
        with foreign(str(path), "a log that can be imported"):
            signals = gather(path, log_mapping, system.robot, report, progress)
            announce_memory(8 * NUMBERS * system.robot.nq * len(signals), f"importing {len(signals):,} rows")
            check_clock(signals, system.robot.revolute.numpy() > 0.0, report)
            check_base(signals, system.robot)
            find_jumps(signals, report)
            derived = tuple(name for name in ("qd", "qdd") if signals.lacking(name).any())
            even_clock(signals, log_mapping.sections.time.period, report)
            derive_joints(signals, system, log_mapping, report)
            smooth = without_noise(signals, log_mapping) if "tau" in signals.vectors else None
            log_mapping = spring_torque(signals, system.robot, log_mapping, report)
            _find_clipped(signals, log_mapping)
            evidence = _contacts(signals, system, log_mapping, report, displaced)
            std = add_derivatives(signals, log_mapping.sections.derivatives, report)
            std = add_imu(signals, std, system.robot, log_mapping, report)
            std = damp(signals, _treat_clipped(signals, std, log_mapping, report), log_mapping, report)
            restore(signals, system.robot, log_mapping, report)
            if smooth is not None:
                find_modelled(signals, smooth, system.robot, report)
            data = _dataset(signals, std, log_mapping, system, report, derived)
    except DataError as error:
        raise error if str(path) in error.message else DataError.at(str(path), error) from None
    return Imported(data, report, tuple(evidence))


def system_of(scene: Scene | ConstrainedSystem | RobotModel | str | Path) -> ConstrainedSystem:
    """Convert a scene (or its file or name) or a robot to a system of a robot with its contacts."""
    if isinstance(scene, ConstrainedSystem):
        return scene
    if isinstance(scene, RobotModel):
        return ConstrainedSystem(scene)
    return (scene if isinstance(scene, Scene) else load_scene(scene)).system()


def _contacts(
    signals: Signals, system: ConstrainedSystem, mapping: Mapping, report: ImportReport, displaced: bool
) -> list[Evidence]:
    """Determine the state of each contact; detection by λ first computes accelerations across switches."""
    if not any(section.source == "multiplier" for section in mapping.sections.contact.values()):
        return detect(signals, system, mapping, report, displaced)
    copies = {name: value.copy() for name, value in signals.vectors.items()}
    trial = replace(signals, vectors=copies, contact={}, row=np.arange(len(signals)))
    std = add_derivatives(trial, mapping.sections.derivatives, ImportReport(report.source))
    add_imu(trial, std, system.robot, mapping, ImportReport(report.source))
    restore(trial, system.robot, mapping, ImportReport(report.source))
    kept = np.zeros(len(signals), dtype=bool)
    kept[trial.row] = True
    signals.keep(kept)
    signals.segment, trial.row, trial.contact = trial.segment, signals.row, signals.contact
    evidence = detect(trial, system, mapping, report, displaced)
    signals.contact = trial.contact
    return evidence


def _find_clipped(signals: Signals, mapping: Mapping) -> None:
    """Mark clipped torques in the vector `clipped`, before a filter smooths their plateaus."""
    speed = np.gradient(signals.vectors["q"], axis=0) if len(signals) > 1 else signals.vectors["q"]
    if mapping.torque.clipped != "keep":
        usable = np.ones(len(signals), dtype=bool)
        signals.vectors["clipped"] = clipped(signals.vectors["tau"], speed, usable).astype(np.float64)


def _treat_clipped(
    signals: Signals, std: Array | None, mapping: Mapping, report: ImportReport
) -> Array | None:
    """Drop rows with clipped torques, or set their noise `tau_std` to their magnitude.

    Filters spread a clipped torque over half their window. Return σ of q̈ in the remaining rows.
    """
    if "clipped" not in signals.vectors or not (mask := signals.vectors.pop("clipped")).any():
        return std
    settings, how = mapping.sections.derivatives, mapping.torque.clipped
    window = settings.window if std is not None and settings.filter_torque else 1
    size = np.abs(signals.vectors["tau"]) * mask
    for rows in signals.runs():
        mask[rows], size[rows] = (maximum_filter1d(x[rows], window, axis=0) for x in (mask, size))
    hit, joints = np.asarray(mask.any(axis=1)), ", ".join(np.array(signals.joint_names)[mask.any(axis=0)])
    done = "were dropped" if how == "drop" else "have a torque noise of its size"
    report.find("clipped", f"the torque of {joints} clips: {hit.sum()} rows {done}", signals.row[hit])
    if how == "drop":
        signals.keep(~hit, split=True)
        return None if std is None else std[~hit]
    signals.vectors["tau_std"] = size
    return std


def _dataset(
    signals: Signals,
    std: Array | None,
    mapping: Mapping,
    system: ConstrainedSystem,
    report: ImportReport,
    derived: tuple[str, ...],
) -> Dataset:
    """Return the data set built from the processed signals."""
    robot, settings, dt = system.robot, mapping.sections.derivatives, usual_step(signals.t)
    margin = settings.impact_margin if settings.impact_margin is not None else 0.5 * settings.window * dt
    of_contacts = {"impact": impact_mask(signals, margin)} if signals.contact else {}
    if "wrench" in signals.vectors and signals.contact:
        of_contacts |= per_contact(signals, system, mapping)
        report.steps.append("took the tool's weight off the wrench and carried it to the contact")
    sticking = stick_speeds(signals, system, mapping, report)
    extras = {} if std is None else {"qdd_std": _tensor(std)}
    if "tau_std" in signals.vectors:
        extras["tau_std"] = _tensor(signals.vectors.pop("tau_std"))
    if "command" in signals.vectors:
        extras["command"] = _tensor(signals.vectors.pop("command"))
    servo = mapping.sections.servo
    names, recording = _recordings(signals, report)
    vectors = {name: _tensor(signals.vectors.pop(name)) for name in ("q", "qd", "qdd", "tau")}
    of_contacts = {key: {name: _tensor(x) for name, x in of.items()} for key, of in of_contacts.items()}
    header = DataHeader(
        dt=dt,
        noise_std=None if std is None else float(np.sqrt(np.mean(std**2))),
        filtered=std is not None,
        filter_span=None if std is None or settings.method == "smoother" else settings.window * dt,
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        provenance=tuple(report.steps),
        derived=derived,
        imported=tuple((finding.kind, finding.message) for finding in report.findings),
        unmeasured_torques=mapping.torque.unmeasured,
        stick_speeds=sticking,
        torque_scale_std=scale_std(mapping),
        torque_constants=torque_constants(mapping, robot.joint_names),
        **({} if servo is None else servo_fields(mapping, robot.joint_names)),
        recordings=names,
        joint_names=robot.joint_names,
        contact_names=tuple(signals.contact),
    )
    return Dataset(
        t=_tensor(signals.t),
        **vectors,
        joint_names=robot.joint_names,
        contact={name: torch.from_numpy(value) for name, value in signals.contact.items()},
        extras=extras,
        contact_extras=of_contacts,
        segment=torch.from_numpy(signals.segment),
        recording=torch.from_numpy(recording),
        header=header,
    )


def _recordings(signals: Signals, report: ImportReport) -> tuple[dict[str, str], NDArray[np.int64]]:
    """Return the recordings, named by the log and their numbers in it, and that of each row (n,).

    The name of a log ends in its hash, since logs of several recordings often have the same name.
    """
    stem = f"{Path(report.source).stem}-{report.log[:DIGITS]}".removesuffix("-")
    if "recording" not in signals.vectors:
        return {stem: report.log}, np.full(len(signals), recording_number(stem))
    numbers, places = np.unique(signals.vectors.pop("recording"), return_inverse=True)
    names = [f"{stem} {number:.0f}" for number in numbers]
    return dict.fromkeys(names, report.log), np.array([*map(recording_number, names)])[places.reshape(-1)]


def _tensor(values: Array) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))
