"""A data set in one line."""

from __future__ import annotations

import torch

from forcegp.data.fields import Fields


def summary(data: Fields) -> str:
    """What a data set logs, without the numbers: samples, joints, duration, contacts, further quantities."""
    robot = f" of {data.header.robot!r}" if data.header.robot else ""
    parts = [f"{len(data)} samples of {len(data.joint_names)} joints"]
    if len(data):
        parts += [_time(data), *_contacts(data)]
    also = [*data.extras, *data.contact_extras]
    parts += [f"also logged: {', '.join(also)}"] if also else []
    kind = str(data.q.dtype).removeprefix("torch.")
    return f"<Dataset{robot}: {'; '.join(parts)}; {kind} on {data.q.device}>"


def _time(data: Fields) -> str:
    count = int(data.segment.unique().numel())
    segments = f"{count} segment{'s' if count != 1 else ''}"
    if not data.header.ordered:
        return f"selected from {segments}, not in order of time"
    _, rows = torch.unique_consecutive(data.segment, return_counts=True)
    last = rows.cumsum(0) - 1
    return f"{float((data.t[last] - data.t[last - rows + 1]).sum()):.4g} s in {segments}"


def _contacts(data: Fields) -> list[str]:
    closed = [f"{name} ({float(value.double().mean()):.0%} closed)" for name, value in data.contact.items()]
    return [f"contact {', '.join(closed)}"] if closed else []


def summary_table(data: Fields) -> tuple[str, tuple[str, ...], list[tuple[object, ...]], list[str]]:
    """Title, head, rows and notes of a table with the range of each joint's motion."""
    names = {"q": "rad, m", "qd": "rad/s, m/s", "tau": "N m, N", "qdd": "rad/s², m/s²"}
    head = ("joint", *(f"{name} [{unit}]" for name, unit in names.items()))
    rows: list[tuple[object, ...]] = []
    for j, joint in enumerate(data.joint_names if len(data) else ()):
        columns = (getattr(data, name)[:, j] for name in names)
        rows.append((joint, *(f"{float(x.min()):.3g} … {float(x.max()):.3g}" for x in columns)))
    return summary(data).strip("<>"), head, rows, list(data.header.provenance)
