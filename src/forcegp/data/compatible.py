"""Whether a data set fits a robot and its contacts, and data sets fit each other."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from forcegp.data.fields import JOINT_VECTORS, Fields
from forcegp.data.header import DataHeader
from forcegp.errors import DataError, near_names
from forcegp.robot.model import RobotModel


class RobotMismatchWarning(UserWarning):
    """The data were logged on a robot whose parameters differ from those of the robot they are used with."""


def check_joints(have: Sequence[str], want: Sequence[str], robot: str) -> None:
    """Check that the joints of a log are those of a robot, in its order."""
    if tuple(have) == tuple(want):
        return
    missing = [joint for joint in want if joint not in have]
    if not missing:
        raise DataError(
            f"the joints of the data are not those of robot {robot!r} in its order",
            expected=", ".join(want),
            got=", ".join(have),
            hint="call data.select(robot.joint_names)",
        )
    near = near_names(missing[0], (joint for joint in have if joint not in want))
    raise DataError(
        f"joint {missing[0]!r} of robot {robot!r} is not in the data",
        expected=", ".join(want),
        got=", ".join(have),
        hint=f"is {near[0]!r} in the data the same joint? Rename its columns" if near else lock_hint(missing),
    )


def lock_hint(joints: Sequence[str]) -> str:
    """How to treat joints that a log lacks, such as those of a gripper, as fixed."""
    positions = ", ".join(f"{joint} = 0.0" for joint in joints)
    return f"if they did not move, lock them: locked_joints = {{ {positions} }} under [robot] in a scene file"


def check_robot(data: Fields, robot: RobotModel) -> None:
    """Check that a log is of a robot's joints, in its order; other parameters of the robot are a warning."""
    check_joints(data.joint_names, robot.joint_names, robot.name)
    logged = data.header.robot_fingerprint
    if logged is not None and logged != robot.fingerprint:
        warnings.warn(
            f"the data were logged on robot {data.header.robot!r} (fingerprint {logged}) and are used with "
            f"{robot.name!r} ({robot.fingerprint}): inertia, kinematics, base or gravity differ",
            RobotMismatchWarning,
            stacklevel=3,
        )


def contact_table(data: Fields, contacts: Sequence[str]) -> Tensor:
    """`(n, len(contacts))` bool: which of the named contacts are closed."""
    for name in contacts:
        if name not in data.contact:
            raise DataError(
                f"column 'contact.{name}' is missing",
                expected=f"contact.{name}, 1 where the contact is closed and 0 elsewhere",
                got=", ".join(f"contact.{c}" for c in data.contact) or "no contact column",
            )
    columns_ = [data.contact[name] for name in contacts]
    return torch.stack(columns_, dim=-1) if columns_ else data.segment.new_zeros(len(data), 0).bool()


def check_alike(parts: Sequence[Fields]) -> None:
    """Check that data sets hold the same columns, so that they can be put one after another."""
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
                raise DataError(
                    f"the {what} of data set {number} differ from those of data set 0",
                    expected=first[what],
                    got=value,
                )


def common_header(headers: Sequence[DataHeader]) -> DataHeader:
    """The fields on which headers agree; the others get their default."""
    first = headers[0].model_dump()
    agreed = {name: v for name, v in first.items() if all(getattr(h, name) == v for h in headers)}
    steps = tuple(dict.fromkeys(step for header in headers for step in header.provenance))
    agreed["provenance"] = (*steps, f"concatenated {len(headers)} data sets")
    agreed["ordered"] = all(header.ordered for header in headers)
    agreed["filtered"] = any(header.filtered for header in headers)
    agreed["filter_span"] = max((h.filter_span for h in headers if h.filter_span is not None), default=None)
    return DataHeader(**agreed)


def concatenated(parts: Sequence[Fields]) -> dict[str, Any]:
    """Fields of data sets one after another, each with segments of its own; errors as of `check_alike`."""
    check_alike(parts)
    first = parts[0]
    segments, start = [], 0
    for part in parts:
        _, own = torch.unique_consecutive(part.segment, return_inverse=True)
        segments.append(own + start)
        start += int(own.max()) + 1 if len(part) else 0
    return {
        **{name: torch.cat([getattr(p, name) for p in parts]) for name in ("t", *JOINT_VECTORS)},
        "joint_names": first.joint_names,
        "contact": {name: torch.cat([p.contact[name] for p in parts]) for name in first.contact},
        "extras": {name: torch.cat([p.extras[name] for p in parts]) for name in first.extras},
        "contact_extras": {
            name: {c: torch.cat([p.contact_extras[name][c] for p in parts]) for c in group}
            for name, group in first.contact_extras.items()
        },
        "segment": torch.cat(segments),
        "header": common_header([part.header for part in parts]),
    }
