"""The logged motion of a robot: states, torques, accelerations and contacts, one row per sample."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from forcegp.data import fields
from forcegp.data.columns import as_tensors, parse, unparse
from forcegp.data.derivative import SavitzkyGolay
from forcegp.data.fields import JOINT_VECTORS, Fields, mapped
from forcegp.data.table import check_ending, read_table, write_parquet
from forcegp.errors import DataError, check_name
from forcegp.notebook import html_table
from forcegp.robot.model import RobotModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from forcegp.plots import Target


def _time(data: Fields) -> str:
    count = int(data.segment.unique().numel())
    segments = f"{count} segment{'s' if count != 1 else ''}"
    if not data.header.ordered:
        return f"selected from {segments}, not in time order"
    _, rows = torch.unique_consecutive(data.segment, return_counts=True)
    last = rows.cumsum(0) - 1
    return f"{float((data.t[last] - data.t[last - rows + 1]).sum()):.4g} s in {segments}"


class NotLoggedError(DataError, AttributeError):
    """Raised if a quantity is not in the data set."""


@dataclass(frozen=True, eq=False)
class Dataset(Fields):
    """Logged motion of a robot with `nq` joints and `n` samples, in SI units and radians.

    Args:
        t: time, `(n,)` [s]. It increases strictly within a segment unless `header.ordered` is false.
        q, qd, qdd: joint positions, velocities and accelerations, `(n, nq)`.
        tau: motor torque Q_u, `(n, nq)` [N m, N].
        joint_names: names of the joints in column order.
        contact: mask `(n,)` of the rows in which a contact is closed, keyed by contact.
        extras: additional joint vectors `(n, nq)`, keyed by name: `qdd_clean`, `Q`, `Q_z`, `Q_I`, …
        contact_extras: contact quantities `(n,)`, `(n, 3)`, keyed by name and contact: `multiplier`, `F_I`, …
        segment: trajectory number of each row, `(n,)`. By default, there is a single trajectory.
        recording: number of the recording to which each row belongs, `(n,)`, or −1 if it is unknown. Names
            are those in `header.recordings`; a recording without a name is named by its number.
        header: noise, sampling period, robot, seed and provenance.

    Extras are also available as attributes, as in `data.Q_z` and `data.multiplier["table"]`.

    Example:
        >>> import forcegp, torch
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
        >>> q, qd, tau = torch.randn(3, 20, 2, dtype=torch.float64)
        >>> qdd = forcegp.dynamics.forward_dynamics(system.robot, q, qd, tau - 0.5 * qd)
        >>> t = torch.arange(20, dtype=torch.float64)
        >>> data = forcegp.Dataset(t, q, qd, tau, qdd, system.robot.joint_names)
        >>> data.nq, len(data[::2]), len(Dataset.concatenate([data, data]))
        (2, 10, 40)

    Raises:
        DataError: a shape, type, value or time is invalid. The message names the column and row.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "joint_names", tuple(self.joint_names))
        fields.check_tensors(self)
        for name, value in (("segment", 0), ("recording", fields.UNKNOWN)):
            if getattr(self, name) is None:
                default = torch.full(self.t.shape, value, dtype=torch.int64, device=self.t.device)
                object.__setattr__(self, name, default)
        fields.check_layout(self)
        fields.check_values(self)

    def __repr__(self) -> str:
        """Return a summary of samples, joints, duration, contacts and additional quantities."""
        robot = f" of {self.header.robot!r}" if self.header.robot else ""
        parts = [f"{len(self)} samples of {self.nq} joints"]
        if len(self):
            closed = [f"{name} ({float(x.double().mean()):.0%} closed)" for name, x in self.contact.items()]
            parts += [_time(self)] + ([f"contact {', '.join(closed)}"] if closed else [])
        also = [*self.extras, *self.contact_extras]
        parts += [f"also logged: {', '.join(also)}"] if also else []
        kind = str(self.dtype).removeprefix("torch.")
        return f"<Dataset{robot}: {'; '.join(parts)}; {kind} on {self.device}>"

    def __getattr__(self, name: str) -> Any:
        extras, contact_extras = self.__dict__.get("extras", {}), self.__dict__.get("contact_extras", {})
        if name in extras:
            return extras[name]
        if name in contact_extras:
            return contact_extras[name]
        if name.startswith("_"):
            raise AttributeError(name)
        text = f"{name!r} is not logged in this data set"
        raise NotLoggedError(text, expected="one of " + ", ".join([*JOINT_VECTORS, *extras, *contact_extras]))

    def __getitem__(self, rows: object) -> Dataset:
        """Return a data set with the given rows, which are a slice, a mask `(n,)` or indices in any order.

        If the rows are not in time order, `header.ordered` is false, and they cannot be split into stretches.

        Raises:
            DataError: a mask has the wrong length, or an index does not exist.
        """
        index = fields.row_indices(rows, len(self), self.t.device)
        ordered = self.header.ordered and bool((index[1:] > index[:-1]).all())
        header = self.header.model_copy(update={"ordered": ordered})
        return self._map(lambda value: value[index], header=header)

    def in_time_order(self) -> Dataset:
        """Return the same rows sorted by segment and time.

        `header.ordered` is then true, unless two rows of a segment have the same time.
        """
        if self.header.ordered:
            return self
        data = self[fields.in_time(self.t, self.segment)]
        same = data.segment[1:] == data.segment[:-1]
        if bool((same & (data.t.diff() <= 0.0)).any()):
            return data
        return data.replace(header=data.header.model_copy(update={"ordered": True}))

    @property
    def nq(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        """Floating-point type of the columns."""
        return self.q.dtype

    @property
    def device(self) -> torch.device:
        """Device of the columns."""
        return self.q.device

    @property
    def contact_names(self) -> tuple[str, ...]:
        """Names of the contacts, in column order."""
        return tuple(self.contact)

    @property
    def recordings(self) -> tuple[str, ...]:
        """Names of the recordings, without unknown ones, in the order of their first rows."""
        names = {fields.recording_number(name): name for name in self.header.recordings}
        numbers = dict.fromkeys(self.recording.unique_consecutive().tolist())
        return tuple(names.get(k, str(k)) for k in numbers if k != fields.UNKNOWN)

    def named(self, recording: str) -> Dataset:
        """Return the same data as one recording with the given name.

        Recordings of a robot share its friction and links, and each has its own offset of the torques.

        Raises:
            DataError: the name is empty.
        """
        if not recording:
            raise DataError("a recording needs a name", expected="one or more characters", got="none")
        logs = {*self.header.recordings.values()}
        known = {recording: logs.pop() if len(logs) == 1 else ""}
        header = self.header.model_copy(update={"recordings": known})
        number = torch.full_like(self.segment, fields.recording_number(recording))
        return self.replace(recording=number, header=header)

    def active(self, contacts: Sequence[str]) -> Tensor:
        """Return whether each of the named contacts is closed, as a mask `(n, len(contacts))`.

        Raises:
            DataError: the state of a contact is not logged.
        """
        return fields.contact_table(self, contacts)

    def replace(self, **fields: object) -> Dataset:
        """Return a data set with the given fields changed."""
        return dataclasses.replace(self, **fields)  # pyright: ignore[reportArgumentType]

    def with_step(self, step: str) -> Dataset:
        """Return the same data with another line of provenance in the header."""
        return self.replace(header=self.header.with_step(step))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Dataset:
        """Return the same data on a different device or in a different precision."""
        return self._map(lambda x: x.to(device=device, dtype=dtype if x.is_floating_point() else None))

    def select(self, joints: Sequence[str]) -> Dataset:
        """Return a data set with only the given joints, such as `robot.joint_names`, in this order.

        Raises:
            UnknownNameError: a joint is not in the data set. The message suggests the nearest name.
        """
        for joint in joints:
            check_name("joint of the data set", joint, self.joint_names)
        order = [self.joint_names.index(joint) for joint in joints]
        fields = {name: getattr(self, name)[:, order] for name in JOINT_VECTORS}
        extras = {name: value[:, order] for name, value in self.extras.items()}
        header = self.header.model_copy(update={"joint_names": tuple(joints)})
        return self.replace(**fields, extras=extras, joint_names=tuple(joints), header=header)

    def check_robot(self, robot: RobotModel) -> None:
        """Check that the joints match those of the robot and are in the same order.

        Warns:
            RobotMismatchWarning: the robot's parameters differ from those of the logged robot.

        Raises:
            DataError: joints are missing, unknown or in the wrong order. The hint suggests a remedy.
        """
        fields.check_robot(self, robot)

    def plot(
        self, quantity: str | None = None, *, joints: Sequence[str] | None = None, ax: Target = None
    ) -> list[Axes]:
        """Plot the log over time, with contact periods shaded, and return the axes.

        Args:
            quantity: a logged quantity, such as `"tau"` or `"multiplier"`, with one panel per joint or
                contact. By default, q, qd, tau and qdd are plotted, each in one panel with all joints.
            joints: names of the joints to plot. By default, all are plotted.
            ax: matplotlib axes to draw on, one per panel. By default, a new figure is created.

        Raises:
            ForceGPError: the quantity or joint does not exist, or the number of axes is wrong.
        """
        from forcegp.data.plot import plot

        return plot(self, quantity, joints, ax)

    def _repr_html_(self) -> str:
        """Return an HTML table of each joint's range of motion, for notebooks."""
        names = {"q": "rad, m", "qd": "rad/s, m/s", "tau": "N m, N", "qdd": "rad/s², m/s²"}
        head = ("joint", *(f"{name} [{unit}]" for name, unit in names.items()))
        rows: list[tuple[object, ...]] = []
        for j, joint in enumerate(self.joint_names if len(self) else ()):
            columns = (getattr(self, name)[:, j] for name in names)
            rows.append((joint, *(f"{float(x.min()):.3g} … {float(x.max()):.3g}" for x in columns)))
        return html_table(repr(self).strip("<>"), head, rows, self.header.provenance)

    def _map(self, change: Callable[[Tensor], Tensor], **fields: object) -> Dataset:
        """Return the data set with the same change applied to every column."""
        return self.replace(**mapped([self], lambda values: change(values[0])), **fields)

    @staticmethod
    def concatenate(parts: Sequence[Dataset]) -> Dataset:
        """Concatenate data sets, keeping their segments separate.

        Raises:
            DataError: there are no parts, or their joints, contacts, extras, precision or device differ.
        """
        fields.check_alike(parts)
        segments, start = [], 0
        for part in parts:
            _, numbers = torch.unique_consecutive(part.segment, return_inverse=True)
            segments.append(numbers + start)
            start += int(numbers.max()) + 1 if len(part) else 0
        header = fields.common_header([part.header for part in parts])
        shared = {"joint_names": parts[0].joint_names, "segment": torch.cat(segments), "header": header}
        return Dataset(**mapped(parts, torch.cat) | shared)

    @classmethod
    def read(
        cls,
        path: str | Path,
        *,
        differentiate: SavitzkyGolay | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> Dataset:
        """Read a data set from a Parquet or CSV file, with columns as described in docs/formats.md.

        Args:
            path: the file to read.
            differentiate: the method for computing `qd` and `qdd` if they are missing.
            dtype, device: data type and device of the tensors.

        Raises:
            DataError: the file is damaged or is not a valid log. The message names the file, column and row.
        """
        raw, header = read_table(path)
        fields = parse(str(path), raw, header, differentiate)
        with DataError.within(str(path)):
            return cls(**as_tensors(fields, dtype, torch.device(device)))

    def write(self, path: str | Path) -> None:
        """Write the data set to a Parquet file atomically.

        Raises:
            DataError: the file name does not end in `.parquet`.
            OSError: the path cannot be written.
        """
        check_ending(path)
        write_parquet(path, *unparse(self))
