"""The same filter on positions, velocities, accelerations and torques, before torques are explained.

Noise ε on q̈ enters the explained torque as M ε. A fit then gains by shrinking the inertia, as any regression
on noisy columns does; a filter of a tenth of a second takes that away. A linear filter on all columns leaves
M q̈ = Q true up to the change of M and of the bias force within the window.
"""

from __future__ import annotations

import numpy as np

from forcegp.checks.log import Log
from forcegp.data.columns import JOINT_VECTORS

SECONDS = 0.1
"""Length of the filter [s]."""
ORDER = 3
"""Degree of the polynomial: bends of the motion within the window are kept."""


def smoothed(log: Log) -> Log:
    """The log after a Savitzky-Golay filter on each stretch without a contact switch.

    Rows within half a window of an end, a gap or a switch are masked. A log in order of selection, and one
    sampled too slowly for a filter, is left as it is.
    """
    from scipy.signal import savgol_filter

    half = round(SECONDS / log.dt / 2.0) if np.isfinite(log.dt) and log.header.ordered else 0
    if 2 * half + 1 <= ORDER + 1:
        return log
    if log.contact:
        state = np.stack(list(log.contact.values()), axis=1)
        switch = np.concatenate([[False], (state[1:] != state[:-1]).any(axis=1)])
        log = log.replace(segment=2 * log.segment * len(log) + np.cumsum(switch))
    columns = {name: getattr(log, name).copy() for name in JOINT_VECTORS}
    lost = np.ones(len(log), bool)
    for s in log.stretches:
        if s.stop - s.start > 2 * half:
            for name, value in columns.items():
                value[s] = savgol_filter(getattr(log, name)[s], 2 * half + 1, ORDER, axis=0)
            lost[s.start + half : s.stop - half] = False
    return log.replace(**columns).mask(lost) if not lost.all() else log
