"""Interpretation of the columns of a log: `t`, `q.<joint>`, `contact.<name>`, `multiplier.<contact>`, …"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forcegp.data.derivative import SavitzkyGolay, differentiate
from forcegp.data.fields import (
    AXES,
    JOINT_VECTORS,
    UNKNOWN,
    DataHeader,
    Fields,
    component_names,
    named_columns,
)
from forcegp.data.table import Columns, IgnoredColumnsWarning
from forcegp.errors import DataError, near_names
from forcegp.limits import JOINTS, SEGMENT_NUMBER

Arrays = dict[str, Any]
WHAT = {"segment": "trajectory", "recording": "recording"}


def unparse(data: Fields) -> tuple[Columns, DataHeader]:
    """Return the columns and header of a data set in file format."""
    columns: dict[str, Tensor] = {"t": data.t, "segment": data.segment}
    columns |= {"recording": data.recording} if bool((data.recording != UNKNOWN).any()) else {}
    columns |= {f"contact.{name}": value for name, value in data.contact.items()}
    for name, value in named_columns(data).items():
        parts = component_names(name, value, data.joint_names)
        columns |= dict(zip(parts, value.reshape(len(data), len(parts)).unbind(-1), strict=True))
    names = {"joint_names": data.joint_names, "contact_names": tuple(data.contact)}
    arrays = {name: value.detach().cpu().numpy() for name, value in columns.items()}
    return arrays, data.header.model_copy(update=names)


def parse(source: str, raw: Columns, header: DataHeader, method: SavitzkyGolay | None) -> Arrays:
    """Return a data set's arrays from file columns; raise a `DataError` that suggests the nearest column."""
    joints = header.joint_names or tuple(name[2:] for name in raw if name.startswith("q."))
    if not joints:
        raise DataError(f"{source}: no column 'q.<joint>'", expected="one per joint", got=_listing(raw))
    if len(joints) > JOINTS:
        raise DataError(f"{source}: too many joints", expected=f"at most {JOINTS}", got=len(joints))
    contacts = header.contact_names or tuple(name[8:] for name in raw if name.startswith("contact."))
    unread = dict(raw)
    fields: Arrays = {"t": _take(source, unread, "t").astype(float), "joint_names": joints}
    absent = {name for name in ("qd", "qdd") if not any(f"{name}.{joint}" in unread for joint in joints)}
    for name in JOINT_VECTORS:
        if not (method and name in absent):
            fields[name] = _joint_vector(source, unread, name, joints)
    fields["contact"] = {name: _contact(source, unread, f"contact.{name}") for name in contacts}
    n = len(fields["t"])
    fields["segment"] = _numbers(source, unread, "segment", 0, n)
    fields["recording"] = _numbers(source, unread, "recording", UNKNOWN, n)
    fields["extras"], fields["contact_extras"] = _extras(source, unread, joints, contacts)
    if unread:
        text = f"{source}: columns of unknown meaning are ignored: {', '.join(unread)}"
        warnings.warn(text, IgnoredColumnsWarning, stacklevel=4)
    if method and absent:
        header = _fill_in(source, fields, absent, method, header)
    # Without a header in the file, the names follow from the columns.
    fields["header"] = header.model_copy(update={"joint_names": joints, "contact_names": contacts})
    return fields


def as_tensors(fields: Arrays, dtype: torch.dtype, device: torch.device) -> Arrays:
    """Convert the arrays of `parse` to tensors, with real numbers in the requested precision."""

    def convert(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: convert(item) for name, item in value.items()}
        if not isinstance(value, np.ndarray):
            return value
        return torch.tensor(value, dtype=dtype if value.dtype.kind == "f" else None, device=device)

    return {name: convert(value) for name, value in fields.items()}


def _listing(names: Sequence[str] | Columns) -> str:
    listed = list(names)
    return ", ".join(listed[:12]) + (f", … ({len(listed)} columns)" if len(listed) > 12 else "")


def _take(source: str, unread: Columns, name: str, remedy: str | None = None) -> NDArray[np.generic]:
    if name in unread:
        return unread.pop(name)
    kin = [other for other in unread if other.split(".", 1)[0] == name.split(".", 1)[0]]
    near = near_names(name, kin or unread, cutoff=0.75)
    text = f"{source}: column {name!r} is missing"
    hint = remedy or (f"did you mean column {near[0]!r}?" if near else None)
    raise DataError(text, expected=name, got=_listing(unread), hint=hint)


def _joint_vector(source: str, unread: Columns, name: str, joints: Sequence[str]) -> NDArray[np.float64]:
    remedy = None
    if name in ("qd", "qdd") and not any(f"{name}.{joint}" in unread for joint in joints):
        remedy = f"compute {name} from the log with differentiate=SavitzkyGolay(...), or --differentiate"
    parts = [_take(source, unread, f"{name}.{joint}", remedy) for joint in joints]
    return np.stack(parts, axis=-1).astype(float)


def _contact(source: str, unread: Columns, name: str) -> NDArray[np.bool_]:
    values = _take(source, unread, name)
    wrong = np.flatnonzero((values != 0) & (values != 1))
    if len(wrong):
        text = f"{source}: column {name!r} is not a flag in row {wrong[0]}"
        raise DataError(text, expected="true or false, or 1 or 0", got=values[wrong[0]])
    return values.astype(bool)


def _numbers(source: str, unread: Columns, name: str, default: int, n: int) -> NDArray[np.int64]:
    values = unread.pop(name, np.full(n, default, np.int64))
    numbers = np.asarray(values, float)
    wrong = np.flatnonzero(~(np.abs(numbers) <= SEGMENT_NUMBER) | (numbers != np.floor(numbers)))
    if len(wrong):
        text = f"{source}: column {name!r} is not a {WHAT[name]} number in row {wrong[0]}"
        raise DataError(text, expected=f"an integer between ±{SEGMENT_NUMBER}", got=values[wrong[0]])
    return values.astype(np.int64)


def _extras(
    source: str, unread: Columns, joints: Sequence[str], contacts: Sequence[str]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, dict[str, NDArray[np.float64]]]]:
    """Remove joint vectors and contact quantities from the unread columns, and return them."""
    extras: dict[str, NDArray[np.float64]] = {}
    contact_extras: dict[str, dict[str, NDArray[np.float64]]] = {}
    names = dict.fromkeys(column.split(".", 1)[0] for column in unread if "." in column)
    for name in names:
        if any(f"{name}.{joint}" in unread for joint in joints):
            extras[name] = _joint_vector(source, unread, name, joints)
        for contact in contacts:
            column = f"{name}.{contact}"
            if column in unread:
                contact_extras.setdefault(name, {})[contact] = unread.pop(column).astype(float)
            elif any(f"{column}.{axis}" in unread for axis in AXES):
                parts = [_take(source, unread, f"{column}.{axis}") for axis in AXES]
                contact_extras.setdefault(name, {})[contact] = np.stack(parts, axis=-1).astype(float)
    return extras, contact_extras


def _fill_in(
    source: str, fields: Arrays, absent: set[str], method: SavitzkyGolay, header: DataHeader
) -> DataHeader:
    """Compute `qd` and `qdd` if missing, and add the standard deviation of the computed q̈ to the header."""
    of, order = ("q", 2) if "qd" in absent else ("qd", 1)

    def derive(name: str, degree: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return differentiate(fields["t"], fields[name], fields["segment"], method, degree)

    with DataError.within(source):
        if "qd" in absent:
            fields["qd"], _ = derive("q", 1)
        if "qdd" in absent:
            fields["qdd"], fields["extras"]["qdd_std"] = derive(of, order)
    step = f"computed {' and '.join(sorted(absent))} from the log by {method}"
    header = header.with_step(step, derived=tuple(sorted({*header.derived, *absent})))
    if "qdd" not in absent:
        return header
    noise = float(np.sqrt(np.mean(fields["extras"]["qdd_std"] ** 2)))
    span = method.window * float(np.median(np.diff(fields["t"])))
    return header.model_copy(update={"noise_std": noise, "filtered": True, "filter_span": span})
