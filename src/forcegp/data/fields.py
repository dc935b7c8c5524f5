"""Header and columns of a data set, and checks of their validity and consistency."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from forcegp.errors import DataError, near_names
from forcegp.files import Header
from forcegp.limits import LOGGED_VALUE
from forcegp.robot.model import RobotModel


class DataHeader(Header):
    """Header of a data set. Every field is optional, so that logs from other programs can be read.

    Attributes:
        dt: sampling period [s].
        noise_std: standard deviation of the noise on q̈ [rad/s²].
        filtered: whether q̈ was computed by a filter, so that its noise is correlated in time. Otherwise,
            `noise_std` refers to white noise.
        filter_span: time span of the filter that computed q̈ [s]. Noise is uncorrelated over longer times.
        robot: name of the robot.
        robot_fingerprint: `RobotModel.fingerprint` of the logged robot.
        seed: random seed used to generate the data.
        ordered: whether rows are in time order within each segment. It is false for selected points.
        provenance: processing steps applied to the data, oldest first.
        derived: names of the joint vectors that a filter computed.
        imported: kind and message of each finding of the import, including warnings about the mapping.
        unmeasured_torques: names of joints without a measured motor torque. Their torque column is 0.
        stick_speeds: speed below which a contact sticks [m/s], keyed by contact. Other contacts always slide.
        torque_scale_std: relative standard deviation of the scale of each torque, if torques are not measured
            but follow from commands or currents with nominal constants.
        torque_constants: nominal torque of each joint per current [N m/A, N/A], if currents are logged.
        servo_stiffness, servo_damping: nominal k_p and k_d of each servo [N m/rad, N m s/rad], if torques
            follow from the commanded positions `extras["command"]`.
        recordings: hash of the log of each recording, keyed by name; empty if the log is unknown.
        joint_names, contact_names: names in column order, empty if not logged.
    """

    FORMAT: ClassVar[str] = "forcegp-dataset"
    VERSION: ClassVar[int] = 1

    dt: PositiveFloat | None = None
    noise_std: NonNegativeFloat | None = None
    filtered: bool = False
    filter_span: NonNegativeFloat | None = None
    robot: str | None = None
    robot_fingerprint: str | None = None
    seed: int | None = None
    ordered: bool = True
    provenance: tuple[str, ...] = ()
    derived: tuple[str, ...] = ()
    imported: tuple[tuple[str, str], ...] = ()
    unmeasured_torques: tuple[str, ...] = ()
    stick_speeds: dict[str, PositiveFloat] = Field(default_factory=dict)
    torque_scale_std: PositiveFloat | None = None
    torque_constants: tuple[PositiveFloat, ...] = ()
    servo_stiffness: tuple[PositiveFloat, ...] = ()
    servo_damping: tuple[NonNegativeFloat, ...] = ()
    recordings: dict[str, str] = Field(default_factory=dict)
    joint_names: tuple[str, ...] = ()
    contact_names: tuple[str, ...] = ()

    @property
    def filter_variance(self) -> float:
        """Second moment of the weights with which the filter averages q̈ over time [s²], or 0 if unknown.

        The second derivative of cubics fitted to positions over a span T is q̈ + T²/56 d²q̈/dt² + …, like
        that of an average with variance T²/28. The first derivative of cubics fitted to q̇ has no such term.
        """
        return (self.filter_span or 0.0) ** 2 / 28.0 if {"qd", "qdd"} <= set(self.derived) else 0.0

    def with_step(self, step: str, **fields: object) -> DataHeader:
        """Return the header with the given fields changed and another line of provenance."""
        return self.model_copy(update={"provenance": (*self.provenance, step), **fields})


JOINT_VECTORS = ("q", "qd", "tau", "qdd")
"""Joint vectors contained in every data set."""
NUMBERS = ("segment", "recording")
"""Integer columns of a data set."""
AXES = ("x", "y", "z")
"""Components of a Cartesian vector logged for a contact."""


UNKNOWN = -1
"""Number of an unknown recording."""


def recording_number(name: str) -> int:
    """Return the number of a recording, which is its name or the 53-bit hash of its name.

    >>> recording_number("12"), recording_number("run") == recording_number("run")
    (12, True)
    """
    if name.isdecimal() and len(name) < 16 and str(int(name)) == name:
        return int(name)
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") >> 11


@dataclass(frozen=True, eq=False)
class Fields:
    """Fields of a data set, which are documented in `Dataset`."""

    t: Tensor
    q: Tensor
    qd: Tensor
    tau: Tensor
    qdd: Tensor
    joint_names: tuple[str, ...]
    contact: Mapping[str, Tensor] = field(default_factory=dict)
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    contact_extras: Mapping[str, Mapping[str, Tensor]] = field(default_factory=dict)
    segment: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in by the data set
    recording: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in by the data set
    header: DataHeader = field(default_factory=DataHeader)

    def __len__(self) -> int:
        """Return the number of samples."""
        return self.t.shape[0]


def component_names(name: str, value: Tensor, joint_names: Sequence[str]) -> list[str]:
    """Return the column names of a joint vector, or of a contact's scalar or Cartesian vector."""
    if value.ndim == 1:
        return [name]
    return [f"{name}.{part}" for part in (AXES if "." in name else joint_names)]


def named_columns(data: Fields) -> dict[str, Tensor]:
    """Return all floating-point columns except time, keyed by their name on disk. Vectors are not split."""
    named = {name: getattr(data, name) for name in JOINT_VECTORS} | dict(data.extras)
    for name, group in data.contact_extras.items():
        named |= {f"{name}.{contact}": value for contact, value in group.items()}
    return named


def mapped(parts: Sequence[Fields], change: Callable[[list[Tensor]], Tensor]) -> dict[str, Any]:
    """Combine data sets with equal layouts by applying `change` to the tensors of each column."""
    first = parts[0]
    return {
        **{name: change([getattr(p, name) for p in parts]) for name in ("t", *NUMBERS, *JOINT_VECTORS)},
        "contact": {name: change([p.contact[name] for p in parts]) for name in first.contact},
        "extras": {name: change([p.extras[name] for p in parts]) for name in first.extras},
        "contact_extras": {
            name: {c: change([p.contact_extras[name][c] for p in parts]) for c in group}
            for name, group in first.contact_extras.items()
        },
    }


def check_tensors(data: Fields) -> None:
    """Check that every column is a tensor and every group of columns is a mapping."""
    for name in ("contact", "extras", "contact_extras"):
        _check_kind(name, getattr(data, name), Mapping, "a mapping of names to tensors")
    for name, group in data.contact_extras.items():
        _check_kind(name, group, Mapping, "a mapping of contacts to tensors")
    named = {"t": data.t, **named_columns(data)}
    named |= {f"contact.{name}": value for name, value in data.contact.items()}
    named |= {name: getattr(data, name) for name in NUMBERS if getattr(data, name) is not None}
    for name, value in named.items():
        _check_kind(name, value, Tensor, "a tensor", f"call torch.tensor({name}, dtype=torch.float64)")


def _check_kind(name: str, value: object, kind: type, expected: str, hint: str | None = None) -> None:
    if not isinstance(value, kind):
        raise DataError(
            f"column {name!r} is not a tensor" if kind is Tensor else f"{name!r} is not a mapping",
            expected=expected,
            got=type(value).__name__,
            hint=hint,
        )


def check_layout(data: Fields) -> None:
    """Check the shapes, types and devices of the columns, and the names of joints and contacts."""
    n, nq = len(data.t) if data.t.ndim == 1 else -1, len(data.joint_names)
    if n < 0:
        raise DataError("column 't' has the wrong shape", expected="(n,)", got=tuple(data.t.shape))
    if nq == 0 or len(set(data.joint_names)) < nq:
        text = "the joint names are not valid"
        raise DataError(text, expected="one or more distinct", got=data.joint_names)
    shared = sorted(set(data.joint_names) & set(data.contact))
    if shared:
        raise DataError(f"{shared[0]!r} is the name of a joint and of a contact", hint="rename the contact")
    _check_names(data)
    for name, value in (("t", data.t), *named_columns(data).items()):
        _check_type(name, value, data.t)
    for name in (*JOINT_VECTORS, *data.extras):
        _check_shape(name, getattr(data, name), (n, nq), f"{n} samples of {nq} joints")
    numbers = {name: getattr(data, name) for name in NUMBERS}
    for name, value in (*numbers.items(), *data.contact.items()):
        _check_shape(name, value, (n,), f"{n} samples")
    for name, group in data.contact_extras.items():
        for contact, value in group.items():
            if contact not in data.contact:
                raise DataError(
                    f"{name!r} is logged for contact {contact!r}, but the state of this contact is not",
                    expected=f"a contact column for one of {', '.join(data.contact) or 'no contacts'}",
                )
            if value.shape != (n, 3):
                _check_shape(f"{name}.{contact}", value, (n,), f"{n} samples")
    for name, value in data.contact.items():
        if value.dtype != torch.bool:
            raise DataError(f"column 'contact.{name}' has the wrong type", expected="bool", got=value.dtype)
    for name, value in numbers.items():
        if value.dtype != torch.int64:
            raise DataError(f"column {name!r} has the wrong type", expected="int64", got=value.dtype)


def _check_names(data: Fields) -> None:
    """Check that extras do not hide a field or each other, and that their names contain no dots."""
    taken = set(vars(data))
    for name in (*data.extras, *data.contact_extras):
        if name in taken or "." in name or not name:
            text = f"{name!r} cannot be the name of an additional quantity"
            hint = f"{', '.join(sorted(taken))} are taken"
            raise DataError(text, expected="a unique name without a dot", hint=hint)
        taken.add(name)


def _check_type(name: str, value: Tensor, like: Tensor) -> None:
    if not value.is_floating_point() or value.dtype != like.dtype or value.device != like.device:
        wanted = f"{like.dtype} on {like.device}" if like.is_floating_point() else "a floating-point type"
        text = f"column {name!r} is of another type or on another device than 't'"
        raise DataError(text, expected=wanted, got=f"{value.dtype} on {value.device}")


def _check_shape(name: str, value: Tensor, shape: tuple[int, ...], meaning: str) -> None:
    if tuple(value.shape) != shape:
        text = f"column {name!r} has the wrong shape"
        raise DataError(text, expected=f"{shape}, {meaning}", got=tuple(value.shape))


def check_values(data: Fields) -> None:
    """Check that values are finite (except undetermined predictions) and that time increases."""
    for name, value in (("t", data.t), *named_columns(data).items()):
        wrong = ~(value.abs() <= LOGGED_VALUE)
        if name.startswith("predicted_"):
            wrong &= ~value.isnan()
        if bool(wrong.any()):
            place = torch.nonzero(wrong)[0].tolist()
            column = component_names(name, value, data.joint_names)[place[1] if len(place) > 1 else 0]
            raise DataError(
                f"column {column!r} holds {value[tuple(place)].item()} in row {place[0]}",
                expected=f"a finite number in every row, up to ±{LOGGED_VALUE:g}",
                got=f"{int(wrong.sum())} values in {name!r} that are not",
                hint="drop or repair these rows before using the log",
            )
    if data.header.ordered:
        check_time(data)


def check_time(data: Fields) -> None:
    """Check that segments are contiguous and that time increases; raise a `DataError` that names the row."""
    t, segment = data.t, data.segment
    same = segment[1:] == segment[:-1]
    back = same & (t[1:] <= t[:-1])
    if bool(back.any()):
        row = int(torch.nonzero(back)[0]) + 1
        raise DataError(
            f"column 't' does not increase in row {row}",
            expected=f"more than {t[row - 1].item():.9g} s",
            got=f"{t[row].item():.9g} s",
            hint="sort the log by time, or number its trajectories in a column 'segment'; select points with "
            "data[rows], or pass header=DataHeader(ordered=False) if the rows are points in any order",
        )
    runs = segment[torch.cat([same.new_ones(min(len(segment), 1)), ~same])]
    if len(runs.unique()) < len(runs):
        seen, values = set(), runs.tolist()
        twice = next(value for value in values if value in seen or seen.add(value))
        text = f"the rows of segment {twice} are not contiguous"
        raise DataError(text, hint="sort the log by 'segment' and 't'")


def in_time(t: Tensor, segment: Tensor) -> Tensor:
    """Return the indices `(n,)` that sort rows by segment, then by time."""
    order = torch.argsort(t, stable=True)
    return order[torch.argsort(segment[order], stable=True)]


def row_indices(rows: object, n: int, device: torch.device) -> Tensor:
    """Return the row numbers `(k,)` of a slice, mask or list. Negative numbers count from the end."""
    if isinstance(rows, slice):
        return torch.tensor(range(n)[rows], dtype=torch.int64, device=device)
    rule = "rows are selected by a slice, a mask or a list of row numbers"
    try:
        index = torch.as_tensor(rows, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise DataError(rule, got=repr(rows)[:80]) from error
    if index.ndim != 1 or (index.is_floating_point() and len(index)):
        raise DataError(rule, got=f"a tensor of shape {tuple(index.shape)} and type {index.dtype}")
    if index.dtype == torch.bool:
        if len(index) != n:
            raise DataError("the mask and the data set differ in length", expected=n, got=len(index))
        return torch.nonzero(index)[:, 0]
    outside = (index < -n) | (index >= n)
    if bool(outside.any()):
        raise DataError("there is no such row", expected=f"0 to {n - 1}", got=int(index[outside][0]))
    return torch.where(index < 0, index + n, index).to(torch.int64)


TURN, MOST_RADIANS = 6.3, 60.0
"""Angle of one turn, and largest plausible angle of a joint without limits [rad]."""


class RobotMismatchWarning(UserWarning):
    """Warning that data were logged on a robot with different parameters."""


def check_joints(have: Sequence[str], want: Sequence[str], robot: str) -> None:
    """Check that the joints of a log are those of the robot, in the same order."""
    if tuple(have) == tuple(want):
        return
    missing = [joint for joint in want if joint not in have]
    if missing:
        near = near_names(missing[0], (joint for joint in have if joint not in want))
        problem = f"joint {missing[0]!r} of robot {robot!r} is not in the data"
        same = f"is {near[0]!r} in the data the same joint? Rename its columns" if near else None
        hint = same or lock_hint(missing)
    else:
        problem = f"the joints of the data are not those of robot {robot!r} in its order"
        hint = "call data.select(robot.joint_names)"
    raise DataError(problem, expected=", ".join(want), got=", ".join(have), hint=hint)


def lock_hint(joints: Sequence[str]) -> str:
    """Return a hint to lock joints that a log does not contain, such as those of a gripper."""
    positions = ", ".join(f"{joint} = 0.0" for joint in joints)
    return f"if they did not move, lock them: locked_joints = {{ {positions} }} under [robot] in a scene file"


def check_robot(data: Fields, robot: RobotModel) -> None:
    """Check that joints match, and warn if robot parameters differ or if angles may be in degrees."""
    check_joints(data.joint_names, robot.joint_names, robot.name)
    q, free = data.q.to(robot.lower) * robot.revolute, torch.full_like(robot.lower, MOST_RADIANS)
    low = robot.lower.where(robot.lower.isfinite(), -free)
    high = robot.upper.where(robot.upper.isfinite(), free)
    beyond, most = int(((q < low) | (q > high)).any(-1).sum()), float(q.abs().max()) if len(data) else 0.0
    if most > TURN and 2 * beyond > len(data):
        warnings.warn(
            f"angles reach {most:.4g} rad, beyond the range of {robot.name!r} in {beyond} of {len(data)} "
            "rows: were they logged in degrees? (`forcegp check`)",
            RobotMismatchWarning,
            stacklevel=3,
        )
    logged = data.header.robot_fingerprint
    if logged is not None and logged != robot.fingerprint:
        warnings.warn(
            f"the data were logged on robot {data.header.robot!r} and are used with {robot.name!r}: inertia, "
            "kinematics, base or gravity differ",
            RobotMismatchWarning,
            stacklevel=3,
        )


def contact_table(data: Fields, contacts: Sequence[str]) -> Tensor:
    """Return a mask `(n, len(contacts))` that is true if the named contact is closed."""
    for name in contacts:
        if name not in data.contact:
            raise DataError(
                f"column 'contact.{name}' is missing",
                expected=f"contact.{name}, 1 where the contact is closed and 0 elsewhere",
                got=", ".join(f"contact.{c}" for c in data.contact) or "no contact column",
            )
    closed = [data.contact[name] for name in contacts]
    return torch.stack(closed, dim=-1) if closed else data.segment.new_zeros(len(data), 0).bool()


def resolution(x: NDArray[Any]) -> NDArray[Any]:
    """Return the step between the levels of each column with few distinct values, and zero elsewhere."""
    steps = np.zeros(x.shape[1])
    for j, levels in enumerate(map(np.unique, x.T)):
        if 2 < len(levels) < 0.75 * len(x):
            gaps = np.diff(levels)
            # Rounding in the last digit can split one level into two; such gaps are not steps.
            gaps = gaps[gaps > 1e-6 * gaps.max()]
            steps[j] = np.median(gaps)
    return steps


def check_alike(parts: Sequence[Fields]) -> None:
    """Check that data sets have the same columns and can be concatenated."""
    if not parts:
        raise DataError("no data sets to concatenate", expected="one or more data sets")

    def layout(data: Fields) -> dict[str, object]:
        return {
            "joints": data.joint_names,
            "contacts": tuple(data.contact),
            "extras": sorted(data.extras),
            "contact extras": sorted((name, *sorted(group)) for name, group in data.contact_extras.items()),
            "types": (data.q.dtype, data.q.device),
        }

    first = layout(parts[0])
    for number, part in enumerate(parts[1:], start=1):
        for what, value in layout(part).items():
            if value != first[what]:
                text = f"the {what} of data set {number} differ from those of data set 0"
                raise DataError(text, expected=first[what], got=value)


def common_stick_speeds(headers: Sequence[DataHeader]) -> dict[str, float]:
    """Return the largest speed below which each contact sticks [m/s], keyed by contact name."""
    speeds = [pair for header in headers for pair in header.stick_speeds.items()]
    return dict(sorted(speeds, key=lambda pair: pair[1]))


def common_header(headers: Sequence[DataHeader]) -> DataHeader:
    """Return a header with the fields on which all headers agree. Other fields have default values."""
    first = headers[0].model_dump()
    agreed = {name: v for name, v in first.items() if all(getattr(h, name) == v for h in headers)}
    steps = tuple(dict.fromkeys(step for header in headers for step in header.provenance))
    agreed["provenance"] = (*steps, f"concatenated {len(headers)} data sets")
    for name in ("derived", "imported"):
        agreed[name] = tuple(dict.fromkeys(value for header in headers for value in getattr(header, name)))
    stated = [header.torque_scale_std for header in headers]
    if any(std is None for std in stated) and any(std is not None for std in stated):
        raise DataError(
            "torques with unknown scales cannot be concatenated with measured ones",
            expected="all from currents or servos, or all measured",
            got=", ".join("measured" if std is None else "currents or commands" for std in stated[:8]),
            hint="import the currents with torque_constant_std = 0 if their constants are known",
        )
    agreed["torque_scale_std"] = max((std for std in stated if std is not None), default=None)
    agreed["stick_speeds"] = common_stick_speeds(headers)
    agreed["recordings"] = common_recordings(headers)
    agreed["ordered"] = all(header.ordered for header in headers)
    agreed["filtered"] = any(header.filtered for header in headers)
    agreed["filter_span"] = max((h.filter_span for h in headers if h.filter_span is not None), default=None)
    return DataHeader(**agreed)


def common_recordings(headers: Sequence[DataHeader]) -> dict[str, str]:
    """Return the recordings of all headers; raise `DataError` if two logs have the same name."""
    recordings: dict[str, str] = {}
    for name, log in (pair for header in headers for pair in header.recordings.items()):
        if log and recordings.get(name):
            if log != recordings[name]:
                raise DataError(
                    f"two recordings are named {name!r}",
                    expected="a distinct name for each log, since a recording has its own offset",
                    got=", ".join(recordings),
                    hint="rename one: data.named('another name'), or `forcegp import --recording`",
                )
        else:
            recordings[name] = log or recordings.get(name, "")
    return recordings
