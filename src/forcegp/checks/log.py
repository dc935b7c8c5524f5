"""Recorded logs, which may be invalid, and the filter used by the torque checks.

Noise ε in q̈ enters the explained torque as M ε. As in any regression on noisy columns, a fit would reduce
its error by shrinking the inertia. Applying the same filter of a tenth of a second to positions, velocities,
accelerations and torques removes the noise. It preserves M q̈ = Q except for changes in M and in the bias
force within the window.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from forcegp.checks.finding import Finding
from forcegp.data.columns import parse
from forcegp.data.dataset import Dataset
from forcegp.data.derivative import SavitzkyGolay, differentiate
from forcegp.data.fields import JOINT_VECTORS, DataHeader, check_joints
from forcegp.data.table import read_table
from forcegp.errors import DataError
from forcegp.robot.model import RobotModel
from forcegp.robust import robust_std
from forcegp.rows import intervals, runs

Array = NDArray[Any]


def evenly(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Select up to `most` of the given rows, evenly spaced."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(np.int64))]


DEPARTURE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0
"""Weights for the deviation of a value from the cubic through its four neighbours."""
OUTER, SPREAD = np.array([3.0, -10.0, 10.0, 0.0, -5.0, 2.0, 0.0]) / 3.0, 3.7
"""Weights for the deviation at x = −3 from the cubic through x = −2, −1, 1, 2; ratio of its standard
deviation to that of the deviation at x = 0, for white noise."""


def spikes(x: Array) -> tuple[Array, Array]:
    """Return each value's deviation from the cubic through its four neighbours, and the neighbours' own.

    e_i = x_i − (−x_{i−2} + 4 x_{i−1} + 4 x_{i+1} − x_{i+2})/6. The second result is the deviation among the
    neighbours alone. A kink in the motion increases both results, a spike only the first. Values must be
    evenly sampled, with shape `(n, d)` and n ≥ 7. Both are zero in the three rows at either end.
    """
    departure, left, right = (correlate1d(x, w, axis=0) for w in (DEPARTURE, OUTER, OUTER[::-1]))
    around = np.maximum(np.abs(left), np.abs(right)) / SPREAD
    for value in (departure, around):
        value[:3] = value[-3:] = 0.0
    return departure, around


def position_unit(robot: RobotModel, j: int | np.integer) -> str:
    """Return the unit of the position of joint j."""
    return "rad" if robot.joint_types[j] == "revolute" else "m"


def force_unit(robot: RobotModel, j: int | np.integer) -> str:
    """Return the unit of the force or torque at joint j."""
    return "N m" if robot.joint_types[j] == "revolute" else "N"


def displacement(robot: RobotModel, j: int | np.integer, offset: float) -> str:
    """Format an offset in the position of joint j as text, with angles also in degrees."""
    degrees = f" ({np.degrees(offset):+.2f}°)" if robot.joint_types[j] == "revolute" else ""
    return f"{offset:+.4f} {position_unit(robot, j)}{degrees}"


GAP, CLOCK_SPREAD = 1.5, 10.0
"""A gap is longer than this multiple of the median step. It also exceeds the median step by this many robust
standard deviations, to allow for clock jitter."""
SHORTEST, FILTER_SECONDS, FILTER_ORDER = 8, 0.1, 3
"""Minimum number of rows in a contiguous run; length [s] and degree of the Savitzky-Golay filters."""


@dataclass(frozen=True, eq=False)
class Log:
    """Columns of a log that have not been validated, with the same names as in a `Dataset`. `derived` names
    the computed columns. `masked`, shape (n,), marks rows that subsequent checks ignore.
    """

    t: Array
    q: Array
    qd: Array
    qdd: Array
    tau: Array
    segment: NDArray[np.int64]
    contact: Mapping[str, NDArray[np.bool_]]
    joint_names: tuple[str, ...]
    header: DataHeader
    derived: frozenset[str] = frozenset()
    masked: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t)

    @property
    def nq(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def all_rows(self) -> tuple[tuple[int, int], ...]:
        """All rows of the log as a single interval."""
        return ((0, len(self)),)

    def finding(self, kind: str, text: str, joints: tuple[str, ...] = (), **evidence: Any) -> Finding:
        """Return a finding about the whole log."""
        return Finding(kind, text, self.all_rows, joints, evidence=evidence)

    def on_joints(self, kind: str, mask: Array, text: str, **evidence: Any) -> list[Finding]:
        """Return one finding on the joints in a mask, with their names in place of `{}`, or no finding."""
        joints = self.named(mask)
        return [self.finding(kind, text.format(", ".join(joints)), joints, **evidence)] if joints else []

    def named(self, joints: Array | np.bool_) -> tuple[str, ...]:
        """Return the names of the joints selected by a mask."""
        return tuple(self.joint_names[j] for j in np.flatnonzero(joints))

    @property
    def unmeasured(self) -> list[int]:
        """Indices of the joints whose torque is not measured according to the header."""
        return [j for j, name in enumerate(self.joint_names) if name in self.header.unmeasured_torques]

    def tensors(self, rows: NDArray[np.int64], *names: str) -> list[torch.Tensor]:
        """Return the given rows of the named columns as tensors."""
        return [torch.from_numpy(np.ascontiguousarray(getattr(self, name)[rows])) for name in names]

    def replace(self, **fields: Any) -> Log:
        """Return the log with the given fields replaced."""
        return dataclasses.replace(self, **fields)

    def changed(self, names: Sequence[str], *, order: Sequence[int] = (), flip: Sequence[int] = ()) -> Log:
        """Return the log with two joints swapped, or the signs of joints flipped, in the named columns."""
        index, sign = np.arange(self.nq), np.ones(self.nq)
        index[list(order)], sign[list(flip)] = order[::-1], -1.0
        return self.replace(**{name: getattr(self, name)[:, index] * sign for name in names})

    def mask(self, rows: NDArray[np.bool_]) -> Log:
        """Return the log with additional rows masked."""
        return self.replace(masked=rows if self.masked is None else self.masked | rows)

    @cached_property
    def finite(self) -> NDArray[np.bool_]:
        """Mask `(n,)` of rows in which all numbers are finite."""
        vectors = np.concatenate([getattr(self, name) for name in JOINT_VECTORS], axis=1)
        return np.isfinite(self.t) & np.isfinite(vectors).all(axis=1)

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Mask `(n,)` of rows that are finite and not masked."""
        return self.finite if self.masked is None else self.finite & ~self.masked

    def reach(self, name: str) -> Array:
        """Return the range (nq,) of a column for each joint, excluding the most extreme values."""
        return np.ptp(np.percentile(getattr(self, name)[self.usable], (0.5, 99.5), axis=0), axis=0)

    @cached_property
    def steps(self) -> Array:
        """Time steps (n − 1,) [s], with NaN between segments."""
        return np.where(np.diff(self.segment) == 0, np.diff(self.t), np.nan)

    @cached_property
    def dt(self) -> float:
        """Median of the positive time steps [s], or NaN if there are none."""
        forward = self.steps[self.steps > 0.0]
        return float(np.median(forward)) if len(forward) else float("nan")

    @cached_property
    def longest_step(self) -> float:
        """Longest time step that does not count as a gap [s]."""
        forward = self.steps[self.steps > 0.0]
        spread = float(robust_std(forward)) if len(forward) else 0.0
        return max(GAP * self.dt, self.dt + CLOCK_SPREAD * spread)

    @cached_property
    def stretches(self) -> list[slice]:
        """Contiguous runs of usable rows within one segment and without a gap in time."""
        linked = (self.steps > 0.0) & (self.steps <= self.longest_step) & self.usable[1:] & self.usable[:-1]
        spans = intervals(linked, least=SHORTEST - 1) if self.header.ordered else ()
        return [slice(a, b + 1) for a, b in spans]

    def rows(self, most: int, margin: int = 0) -> NDArray[np.int64]:
        """Return up to `most` evenly spaced usable rows, at least `margin` rows from the end of any run."""
        inner = [np.arange(s.start + margin, s.stop - margin) for s in self.stretches]
        index = np.concatenate([np.empty(0, np.int64), *inner])
        index = index if self.header.ordered else np.flatnonzero(self.usable)
        return evenly(index, most)


Outcome = tuple[list[Finding], Log]
"""Result of a check: its findings, and the corrected log for the subsequent checks."""


def log_of(data: Dataset) -> Log:
    """Convert a data set to a log."""
    return Log(
        **{n: getattr(data, n).detach().cpu().numpy().astype(float) for n in ("t", *JOINT_VECTORS)},
        segment=data.segment.cpu().numpy(),
        contact={name: value.cpu().numpy() for name, value in data.contact.items()},
        joint_names=data.joint_names,
        header=data.header,
    )


def read_log(path: str | Path) -> Log:
    """Read a log from a Parquet or CSV file, accepting NaN, empty values and time stamps that run backward.

    The columns are described in docs/formats.md. Missing q̇ and q̈ are computed by a Savitzky-Golay filter.

    Raises:
        DataError: the file is damaged, or a required column is missing.
    """
    raw, header = read_table(path, missing="nan")
    joints = header.joint_names or tuple(name[2:] for name in raw if name.startswith("q."))
    absent = [n for n in ("qd", "qdd") if not any(f"{n}.{joint}" in raw for joint in joints)]
    for name in absent:
        raw |= {f"{name}.{joint}": np.full_like(raw["t"], np.nan, dtype=float) for joint in joints}
    fields = parse(str(path), raw, header, None)
    del fields["extras"], fields["contact_extras"], fields["recording"]
    return derive(Log(**fields), absent)


def derive(log: Log, absent: list[str]) -> Log:
    """Return the log with missing derivatives computed in each contiguous run of rows, and NaN elsewhere."""
    filled = log.replace(**{name: np.zeros_like(log.q) for name in absent})
    values = {name: np.full_like(log.q, np.nan) for name in absent}
    # With a wrong unit of time, a window of a fixed duration might be longer than the log.
    longest = max((s.stop - s.start for s in filled.stretches), default=0)
    half = min(FILTER_SECONDS / log.dt, longest / 4.0) / 2.0 if np.isfinite(log.dt) else 0.0
    window = 2 * max(3, round(half)) + 1
    method = SavitzkyGolay(window, FILTER_ORDER)
    for rows in filled.stretches:
        even = filled.dt * np.arange(rows.stop - rows.start)
        for name in absent if len(even) >= window else ():
            source, degree = ("q", 1) if name == "qd" else ("q", 2) if "qd" in absent else ("qd", 1)
            one = np.zeros(len(even), np.int64)
            values[name][rows] = differentiate(even, getattr(log, source)[rows], one, method, degree)[0]
    return log.replace(**values, derived=log.derived | set(absent))


def computed(log: Log) -> set[str]:
    """Return the names of the joint vectors that were computed by a filter, here or at import."""
    return set(log.derived) | set(log.header.derived)


def recomputed(log: Log) -> Log:
    """Return the log with its computed derivatives computed again, after a change of positions or times."""
    names = [name for name in ("qd", "qdd") if name in computed(log)]
    return derive(log, names) if names else log


def of_robot(log: Log, robot: RobotModel) -> Log:
    """Return the log with joints in the robot's order; raise `DataError` if it is empty or lacks a joint."""
    if len(log) == 0:
        raise DataError("the log contains no rows", expected="one or more samples")
    if not set(robot.joint_names) <= set(log.joint_names):
        check_joints(log.joint_names, robot.joint_names, robot.name)
    order = [log.joint_names.index(joint) for joint in robot.joint_names]
    columns = {name: getattr(log, name)[:, order] for name in JOINT_VECTORS}
    return log.replace(**columns, joint_names=robot.joint_names)


def smoothed(log: Log) -> Log:
    """Apply a Savitzky-Golay filter to a valid log between contact switches, and mask the ends."""
    from scipy.signal import savgol_filter

    half = round(FILTER_SECONDS / log.dt / 2.0) if np.isfinite(log.dt) and log.header.ordered else 0
    if 2 * half + 1 <= FILTER_ORDER + 1:
        return log
    pieces = runs(log.segment, *log.contact.values())
    log = log.replace(segment=np.repeat(np.arange(len(pieces)), [s.stop - s.start for s in pieces]))
    columns = {name: getattr(log, name).copy() for name in JOINT_VECTORS}
    lost = np.ones(len(log), bool)
    for s in (s for s in log.stretches if s.stop - s.start > 2 * half):
        lost[s.start + half : s.stop - half] = False
        for name, value in columns.items():
            value[s] = savgol_filter(getattr(log, name)[s], 2 * half + 1, FILTER_ORDER, axis=0)
    return log.replace(**columns).mask(lost) if not lost.all() else log
