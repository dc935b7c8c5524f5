"""Conversion of a mapped table to quantities in SI units and in the robot's joint order.

A reading r is converted to y = s k (r − o), with one set of numbers per joint. Here, o is the reading at zero
in the unit of the column, s = ±1 is the sign, and k is the unit, multiplied by the torque constant K_t for a
current. With a gear of ratio N, a motor turns N times as fast as its joint, and the joint torque is N times
the motor torque: q = q_m / N, τ = N τ_m. If drives are coupled, these are the drives' own coordinates p = C q
and torques τ_p, and q = C⁻¹ p, τ = Cᵀ τ_p.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from forcegp import limits
from forcegp.errors import DataError
from forcegp.logs import units
from forcegp.logs.base import FOOT, ORIENTATION, check_base, columns_of_base, orientations, place_base
from forcegp.logs.clock import drop_repeated, find_held, join_stream, split_trajectories
from forcegp.logs.headings import doubtful, named_like, tokens
from forcegp.logs.mapping import COMMANDS, LOGGED, SYMBOLS, TORQUES, Mapping
from forcegp.logs.motion import TURNS, find_wrapped
from forcegp.logs.readers import read
from forcegp.logs.table import Array, ImportReport, LogTable, Progress, Signals, Stream
from forcegp.robot import RobotModel
from forcegp.rows import describe, numbered

CLOSED, STICKS = "contact ", "sticks "
"""Prefixes of the contact name for vectors in `Signals` that flag the state of the contact."""


def gather(
    path: str | Path,
    mapping: Mapping,
    robot: RobotModel,
    report: ImportReport,
    progress: Progress | None = None,
    rows: int | None = None,
) -> Signals:
    """Read the mapped columns of a log onto a common clock, with at most `rows` rows if possible."""
    sections, joints = mapping.sections, robot.joint_names
    needed = {*sections.time.columns, sections.time.segment, sections.time.recording} - {None}
    for name in LOGGED:
        if mapping.quantity(name) is not None:
            needed |= set(mapping.columns_of(name, joints))
    if sections.wrench is not None:
        needed |= {*sections.wrench.force, *(sections.wrench.torque or ())}
    if sections.base is not None:
        needed |= {column for _, columns, *_ in columns_of_base(sections.base) for column in columns}
        needed |= set(sections.base.feet.values())
    needed |= {c for each in sections.contact.values() for c in (each.column, each.sticks) if c is not None}
    table = read(path, wanted=needed.__contains__, rows=rows, progress=progress)
    report.format = table.format
    for remark in table.remarks:
        report.find("reader", remark)
    _find_names(table, mapping, joints, report)
    return _Gathering(table, mapping, robot, report).run()


def _find_names(table: LogTable, mapping: Mapping, joints: Sequence[str], report: ImportReport) -> None:
    """Find columns and streams named like commands or model outputs, and currents without a motor."""
    for quantity in (name for name in SYMBOLS if mapping.quantity(name) is not None):
        section = mapping.quantity(quantity)
        assert section is not None
        column = next(iter(mapping.columns_of(quantity, joints)), "")
        streams = [stream.name for stream in table.streams if column in stream.columns]
        for name in (column, section.stream or next(iter(streams), "")):
            if (reason := doubtful(name)) is not None:
                report.find("named", named_like(name, reason, quantity))
    torque = mapping.sections.torque
    if torque is None:
        return
    column = next(iter(mapping.columns_of("torque", joints)), "")
    if torque.unit in units.CURRENT:
        measured = mapping.measured("torque", joints)
        factors = mapping.per_joint("torque", "torque_constant", measured)
        if torque.side == "motor":
            factors = factors * mapping.per_joint("torque", "gear_ratio", measured)
        if len(factors) and (factors == 1.0).all():
            text = "torques are currents at 1 N m/A: give torque_constant and gear_ratio under [torque]"
            report.find("current", text)
    elif {"current", "currents"}.intersection(tokens(column)):
        report.find("current", f"{column!r} is named like a current, but is read as a torque")


class _Gathering:
    """Extraction of the mapped columns from a table."""

    def __init__(self, table: LogTable, mapping: Mapping, robot: RobotModel, report: ImportReport) -> None:
        self.table, self.mapping, self.robot, self.report = table, mapping, robot, report
        self.joints = joints = robot.joint_names
        self.time, position = mapping.sections.time, mapping.columns_of("position", joints)
        if not position:
            raise mapping.error(
                ("position",), "no joint is left", expected="a joint beside those of the base"
            )
        check_base(robot, mapping)
        self.origin: list[float] = []
        self.reference = table.stream_of(position[0], mapping.sections.position.stream)

    def run(self) -> Signals:
        """Return the quantities, interpolating those of other streams onto the reference stream."""
        quantities = [name for name in LOGGED if self._is_logged(name)]
        vectors = {LOGGED[name]: self._vector(name) for name in quantities}
        if self.mapping.sections.wrench is not None:
            vectors["wrench"] = self._wrench()
        vectors |= {**self._flags(), **self._base()}
        if self.time.recording is not None:
            vectors["recording"] = self.reference, self._recording(self.time.recording)
        signals = self._reference({n: x for n, (stream, x) in vectors.items() if stream is self.reference})
        for name, (stream, values) in vectors.items():
            if stream is not self.reference:
                t = self._stamps(stream)
                good = np.isfinite(values).all(axis=1) & np.isfinite(t)
                join_stream(signals, name, t[good], values[good], self.time.gap, self.report)
        for key in [key for key in signals.vectors if key.startswith(CLOSED)]:
            signals.contact[key.removeprefix(CLOSED)] = signals.vectors.pop(key)[:, 0] >= 0.5
        place_base(signals, self.robot, self.mapping, self.report)
        return signals

    def _is_logged(self, name: str) -> bool:
        """Return whether a quantity is mapped and logged. Velocities and accelerations are not required."""
        if self.mapping.quantity(name) is None:
            return False
        columns = self.mapping.columns_of(name, self.joints)
        absent = [column for column in columns if column not in self.table.names]
        if name in ("position", "torque", *COMMANDS) or not absent:
            return True
        self.report.find("computed", f"the log has no column {absent[0]!r}: the {name} is computed")
        return False

    def _take(self, stream: Stream, column: str) -> Array:
        return self.table.stream_of(column, stream.name).columns[column]

    def _vector(self, name: str) -> tuple[Stream, Array]:
        """Return a joint vector in SI units on the joint side. Joints that are not logged are zero."""
        joints, section = self.mapping.measured(name, self.joints), self.mapping.quantity(name)
        assert section is not None
        columns = self.mapping.columns_of(name, self.joints)
        if not columns:
            raise self.mapping.error((name, "unmeasured"), "no joint is left", expected="some joints")
        stream = self.table.stream_of(columns[0], section.stream)
        scale, offset = self._scale(name), self.mapping.per_joint(name, "offset", joints)
        result = np.zeros((len(stream), len(self.joints)))
        for i, (joint, column) in enumerate(zip(joints, columns, strict=True)):
            values = result[:, self.joints.index(joint)]
            np.subtract(self._take(stream, column), offset[i], out=values)
            values *= scale[self.joints.index(joint)]
            if isinstance(stream.columns, dict) and len(stream.columns) > 1:
                del stream.columns[column]  # hold only one copy in memory
        return stream, self._of_joints(name, result) if section.side == "motor" else result

    def _of_joints(self, name: str, values: Array) -> Array:
        """Convert a vector of drives (n, nq) to one of joints, which differ if drives are coupled."""
        robot, measured = self.robot, self.mapping.measured(name, self.joints)
        if robot.coupling is None:
            return values
        mixed = robot.coupling != torch.eye(robot.nq).to(robot.coupling)
        involved = [self.joints[i] for i in (mixed.any(0) | mixed.any(1)).nonzero()[:, 0].tolist()]
        lacking = [joint for joint in involved if joint not in measured]
        if lacking:
            raise self.mapping.error(
                (name,),
                f"joint {lacking[0]!r} has a coupled drive, but no column",
                expected=f"a column for each of {', '.join(involved)}",
            )
        convert = robot.joint_torque if name in TORQUES else robot.joint_motion
        return convert(torch.from_numpy(values).to(robot.coupling)).numpy()

    def _scale(self, name: str) -> Array:
        """Return the factors s k (nq,) that convert a joint vector to SI units on the joint side."""
        joints, section = self.mapping.measured(name, self.joints), self.mapping.quantity(name)
        assert section is not None

        def numbers(key: str) -> Array:
            return self.mapping.per_joint(name, key, joints)

        scale = numbers("sign") * units.QUANTITY[name][section.unit]
        if section.side == "motor":
            scale *= numbers("gear_ratio") ** (1.0 if name in TORQUES else -1.0)
        if name == "torque" and self.mapping.torque.torque_constant is not None:
            scale *= numbers("torque_constant")
        result = np.ones(len(self.joints))
        result[[self.joints.index(joint) for joint in joints]] = scale
        return result

    def _wrench(self) -> tuple[Stream, Array]:
        """Return force and moment (n, 6) in SI units without offsets, with zeros for missing components."""
        section = self.mapping.sections.wrench
        assert section is not None
        stream = self.table.stream_of(section.force[0], section.stream)
        scales = [units.FORCE[section.force_unit]] * 3 + [units.TORQUE[section.torque_unit]] * 3
        columns, result = (*section.force, *(section.torque or ())), np.zeros((len(stream), 6))
        for i, column in enumerate(columns):
            result[:, i] = (self._take(stream, column) - section.offset[i]) * scales[i]
        if len(columns) == 1:
            result[:, :3] = np.outer(result[:, 0], section.axis)
        return stream, result

    def _flags(self) -> dict[str, tuple[Stream, Array]]:
        """Return the flags of closed and sticking contacts, and of feet at rest, keyed by `CLOSED`, `STICKS`
        or `FOOT` plus the name."""
        columns: dict[str, tuple[str | None, str | None]] = {}
        for name, section in self.mapping.sections.contact.items():
            columns[f"{CLOSED}{name}"] = (
                section.column if section.source == "column" else None,
                section.stream,
            )
            columns[f"{STICKS}{name}"] = section.sticks, section.stream
        if (base := self.mapping.sections.base) is not None:
            columns |= {f"{FOOT}{frame}": (column, base.stream) for frame, column in base.feet.items()}
        flags = {}
        for key, (column, name) in columns.items():
            if column is None:
                continue
            stream = self.table.stream_of(column, name)
            values = self._take(stream, column)
            wrong = np.flatnonzero((values != 0.0) & (values != 1.0))
            if len(wrong):
                text = f"{self.table.source}: column {column!r} is not a flag in row {wrong[0]}"
                raise DataError(text, expected="0 or 1", got=values[wrong[0]])
            flags[key] = stream, values[:, None]
        return flags

    def _base(self) -> dict[str, tuple[Stream, Array]]:
        """Return the vectors of a floating base (n, 3) in SI units, and its quaternions (n, 4)."""
        if (section := self.mapping.sections.base) is None:
            return {}
        vectors = {}
        for name, columns, factor, where in columns_of_base(section):
            stream = self.table.stream_of(columns[0], where)
            values = factor * np.stack([self._take(stream, column) for column in columns], axis=1)
            turn = name == ORIENTATION
            vectors[name] = stream, orientations(values, section, self.report) if turn else values
        return vectors

    def _recording(self, column: str) -> Array:
        """Return the number of the recording of each row (n, 1)."""
        values = self._take(self.reference, column)
        wrong = np.flatnonzero((values != np.floor(values)) | (np.abs(values) > limits.SEGMENT_NUMBER))
        if len(wrong):
            text = f"{self.table.source}: column {column!r} does not number recordings in row {wrong[0]}"
            raise DataError(text, expected="an integer in every row", got=values[wrong[0]])
        return values[:, None]

    def _stamps(self, stream: Stream) -> Array:
        """Return the time stamps of a stream [s]."""
        columns, holder = self.time.columns, stream
        if columns[0] not in stream.columns:
            if len(self.table.streams) > 1 and stream is not self.reference:
                text = f"{self.table.source}: stream {stream.name!r} has no column {columns[0]!r}"
                raise DataError(text, expected="a time stamp in every stream that is used")
            holder = self.table.stream_of(columns[0], self.time.stream)
        parts = [self.table.stream_of(column, holder.name).columns[column] for column in columns]
        if len(parts) > 1 and not self.origin:
            # Seconds since 1970 leave float64 no room for nanoseconds.
            self.origin = [float(np.nanmin(values)) for values in parts[:-1]]
            origin = sum(o * k for o, k in zip(self.origin, self.time.factors, strict=False))
            self.report.steps.append(f"added up {' and '.join(columns)}; time 0 is {origin:.9g} s")
        origins = [*self.origin, *[0.0] * (len(parts) - len(self.origin))]
        scaled = [k * (x - o) for x, o, k in zip(parts, origins, self.time.factors, strict=True)]
        return np.sum(scaled, axis=0) if len(scaled) > 1 else scaled[0]

    def _reference(self, vectors: dict[str, Array]) -> Signals:
        """Return the complete, cropped rows of the stream with the positions, and their trajectories."""
        t = self._stamps(self.reference)
        self.report.rows_read = len(t)
        self.report.log = hashlib.sha256(t.tobytes() + vectors["q"].tobytes()).hexdigest()[:16]
        segment = np.zeros(len(t), dtype=np.int64)
        for column in (self.time.segment, self.time.recording):
            if column is not None:
                numbers = self._take(self.reference, column)
                segment[1:] += np.cumsum(numbers[1:] != numbers[:-1])
        signals = Signals(self.joints, t, np.arange(len(t)), segment, vectors)
        self._complete(signals)
        drop_repeated(signals, self.report)
        self._crop(signals)
        split_trajectories(signals, self.time.gap, self.report)
        position = self.mapping.sections.position
        turn = np.abs(self._scale("position")) * TURNS.get(position.unit, np.inf)
        find_wrapped(signals, turn, position.unwrap, self.report)
        if "tau" in signals.vectors:
            find_held(signals, self.time.held == "drop", self.report)
        return signals

    def _complete(self, signals: Signals) -> None:
        bad = ~np.isfinite(signals.t)
        for values in signals.vectors.values():
            bad |= ~np.isfinite(values).all(axis=1)
        if not bad.any():
            return
        rows = signals.row[bad]
        if self.time.missing == "error":
            text = f"{self.table.source}: values are missing or not finite in {describe(numbered(rows))}"
            expected, hint = "a number in every mapped column", 'missing = "drop" under [time] drops them'
            got = f"{len(rows)} incomplete rows of {len(signals)}"
            raise DataError(text, expected=expected, got=got, hint=hint)
        self.report.find("missing", f"{len(rows)} incomplete rows were dropped", rows)
        signals.keep(~bad)

    def _crop(self, signals: Signals) -> None:
        start, stop = self.time.start, self.time.stop
        inside = (signals.t >= start) & (signals.t <= stop)
        if not inside.any():
            span = f"{signals.t.min():.6g} to {signals.t.max():.6g} s" if len(signals) else "no complete row"
            raise DataError(f"{self.table.source}: no row between start and stop", expected=span)
        if not inside.all():
            self.report.steps.append(f"kept the {inside.sum()} rows from {start:g} to {stop:g} s")
            signals.keep(inside)
