"""Whether a data set is valid, and what to say if it is not."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from forcegp.data.fields import JOINT_VECTORS, Fields, component_names
from forcegp.errors import DataError
from forcegp.limits import LOGGED_VALUE


def _named_columns(data: Fields) -> list[tuple[str, Tensor]]:
    """Every floating-point column of the data set but time, by its name on disk, vectors whole."""
    pairs = [(name, getattr(data, name)) for name in JOINT_VECTORS] + list(data.extras.items())
    for name, group in data.contact_extras.items():
        pairs += [(f"{name}.{contact}", value) for contact, value in group.items()]
    return pairs


def check_tensors(data: Fields) -> None:
    """Check that every column is a tensor, and every group of columns a mapping, before they are used."""
    for name in ("contact", "extras", "contact_extras"):
        _check_kind(name, getattr(data, name), Mapping, "a mapping of names to tensors")
    named = {"t": data.t, **{name: getattr(data, name) for name in JOINT_VECTORS}, **data.extras}
    named |= {f"contact.{name}": value for name, value in data.contact.items()}
    if data.segment is not None:
        named["segment"] = data.segment
    for name, group in data.contact_extras.items():
        _check_kind(name, group, Mapping, "a mapping of contacts to tensors")
        named |= {f"{name}.{contact}": value for contact, value in group.items()}
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
    """Check shapes, types and device of the columns, and the names of joints and contacts."""
    n, nq = len(data.t) if data.t.ndim == 1 else -1, len(data.joint_names)
    if n < 0:
        raise DataError("column 't' has the wrong shape", expected="(n,)", got=tuple(data.t.shape))
    if nq == 0 or len(set(data.joint_names)) < nq:
        raise DataError(
            "the joint names are not valid", expected="one or more distinct", got=data.joint_names
        )
    shared = sorted(set(data.joint_names) & set(data.contact))
    if shared:
        raise DataError(f"{shared[0]!r} is the name of a joint and of a contact", hint="rename the contact")
    _check_names(data)
    for name, value in (("t", data.t), *_named_columns(data)):
        _check_type(name, value, data.t)
    for name in (*JOINT_VECTORS, *data.extras):
        _check_shape(name, getattr(data, name), (n, nq), f"{n} samples of {nq} joints")
    for name, value in (("segment", data.segment), *data.contact.items()):
        _check_shape(name, value, (n,), f"{n} samples")
    for name, group in data.contact_extras.items():
        for contact, value in group.items():
            if contact not in data.contact:
                raise DataError(
                    f"{name!r} is logged of contact {contact!r}, whose state is not logged",
                    expected=f"a contact column for one of {', '.join(data.contact) or 'no contacts'}",
                )
            if value.shape != (n, 3):
                _check_shape(f"{name}.{contact}", value, (n,), f"{n} samples")
    for name, value in data.contact.items():
        if value.dtype != torch.bool:
            raise DataError(f"column 'contact.{name}' has the wrong type", expected="bool", got=value.dtype)
    if data.segment.dtype != torch.int64:
        raise DataError("column 'segment' has the wrong type", expected="int64", got=data.segment.dtype)


def _check_names(data: Fields) -> None:
    """Extras must not hide a field, nor each other, and a dot in their name would cut it on disk."""
    taken = set(vars(data))
    for name in (*data.extras, *data.contact_extras):
        if name in taken or "." in name or not name:
            raise DataError(
                f"{name!r} cannot be the name of a further logged quantity",
                expected="a name of its own without a dot",
                hint=f"{', '.join(sorted(taken))} are taken",
            )
        taken.add(name)


def _check_type(name: str, value: Tensor, like: Tensor) -> None:
    if not value.is_floating_point() or value.dtype != like.dtype or value.device != like.device:
        raise DataError(
            f"column {name!r} is of another type or on another device than 't'",
            expected=f"{like.dtype} on {like.device}"
            if like.is_floating_point()
            else "a floating-point type",
            got=f"{value.dtype} on {value.device}",
        )


def _check_shape(name: str, value: Tensor, shape: tuple[int, ...], meaning: str) -> None:
    if tuple(value.shape) != shape:
        raise DataError(
            f"column {name!r} has the wrong shape", expected=f"{shape}, {meaning}", got=tuple(value.shape)
        )


def check_values(data: Fields) -> None:
    """Check that every number is finite, and that time increases within each segment."""
    for name, value in (("t", data.t), *_named_columns(data)):
        if not bool((value.abs() <= LOGGED_VALUE).all()):
            _report_not_finite(data, name, value)
    if data.header.ordered:
        check_time(data)


def _report_not_finite(data: Fields, name: str, value: Tensor) -> None:
    wrong = ~(value.abs() <= LOGGED_VALUE)
    place, count = torch.nonzero(wrong)[0].tolist(), int(wrong.sum())
    column = component_names(name, value, data.joint_names)[place[1] if len(place) > 1 else 0]
    raise DataError(
        f"column {column!r} holds {value[tuple(place)].item()} in row {place[0]}",
        expected=f"a finite number in every row, up to ±{LOGGED_VALUE:g}",
        got=f"{count} values in {name!r} that are not",
        hint="drop or repair these rows before using the log",
    )


def check_time(data: Fields) -> None:
    """Check that rows of a segment are together, and that time increases strictly within each.

    Raises:
        DataError: they are not; the message names the row.
    """
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
        raise DataError(
            f"the rows of segment {twice} are not together", hint="sort the log by 'segment' and 't'"
        )


def row_indices(rows: object, n: int, device: torch.device) -> Tensor:
    """Row numbers `(k,)` of a slice, mask or list of indices, negative ones counted from the end.

    Raises:
        DataError: a mask of another length, or an index that does not exist.
    """
    if isinstance(rows, slice):
        return torch.tensor(range(n)[rows], dtype=torch.int64, device=device)
    try:
        index = torch.as_tensor(rows, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise DataError(
            "rows are selected by a slice, a mask or a list of row numbers", got=repr(rows)[:80]
        ) from error
    if index.ndim != 1 or (index.is_floating_point() and len(index)):
        raise DataError(
            "rows are selected by a slice, a mask or a list of row numbers",
            got=f"a tensor of shape {tuple(index.shape)} and type {index.dtype}",
        )
    if index.dtype == torch.bool:
        if len(index) != n:
            raise DataError("the mask has another length than the data set", expected=n, got=len(index))
        return torch.nonzero(index)[:, 0]
    outside = (index < -n) | (index >= n)
    if bool(outside.any()):
        raise DataError("there is no such row", expected=f"0 to {n - 1}", got=int(index[outside][0]))
    return torch.where(index < 0, index + n, index).to(torch.int64)
