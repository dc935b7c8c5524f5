"""Columns without headings: what their values say of positions, velocities and torques."""

from __future__ import annotations

import numpy as np

from forcegp.logs.draft import Draft, Family
from forcegp.logs.table import Stream
from forcegp.robust import robust_std

RELATED = 0.95
"""Correlation of a velocity with the rate of change of its position, at least."""


def find_by_values(stream: Stream, joints: tuple[str, ...], draft: Draft) -> None:
    """Propose families of a log whose columns have numbers for names.

    The columns beside time come in blocks of one per joint, from base to tip. Positions and velocities are
    two blocks of which one is the rate of change of the other; the block that is left is the torque.
    """
    nq = len(joints)
    names = [name for name in stream.columns if name != draft.time]
    blocks = [names[k : k + nq] for k in range(0, len(names) - nq + 1, nq)]
    if len(names) % nq or not 2 <= len(blocks) <= 4:
        return
    t = stream.columns[draft.time]
    values = [np.stack([stream.columns[name] for name in block], axis=1) for block in blocks]
    pairs = [
        (k, other)
        for k in range(len(blocks))
        for other in range(len(blocks))
        if other != k and _is_rate(t, values[k], values[other])
    ]
    firsts = {k for k, _ in pairs} - {other for _, other in pairs}
    roles: dict[str, int] = {}
    if len(firsts) == 1:
        at = firsts.pop()
        for quantity in ("position", "velocity", "acceleration"):
            roles[quantity] = at
            following = [other for k, other in pairs if k == at]
            if len(following) != 1:
                break
            at = following[0]
    left = [k for k in range(len(blocks)) if k not in roles.values()]
    if "velocity" not in roles or len(left) != 1:
        return
    roles["torque"] = left[0]
    for quantity, k in roles.items():
        columns = dict(zip(joints, blocks[k], strict=True))
        draft.families[quantity] = Family("", columns, stream.name, by_joint=columns)
        text = (
            f"columns {blocks[k][0]} to {blocks[k][-1]} have no headings; their values look like a {quantity}"
        )
        draft.say(quantity, text, doubt=True)


def _is_rate(t: np.ndarray, x: np.ndarray, v: np.ndarray) -> bool:
    """Whether v is proportional to the rate of change of x in every column."""
    step = np.diff(t)[:, None]
    rate, mean = np.diff(x, axis=0), 0.5 * (v[1:] + v[:-1]) * step
    good = (step[:, 0] > 0.0) & np.isfinite(rate).all(axis=1) & np.isfinite(mean).all(axis=1)
    rate, mean = rate[good], mean[good]
    if len(rate) < 10 or not (robust_std(rate) > 0.0).all() or not (robust_std(mean) > 0.0).all():
        return False
    return all(np.corrcoef(a, b)[0, 1] > RELATED for a, b in zip(rate.T, mean.T, strict=True))
