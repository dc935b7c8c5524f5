"""Velocities and accelerations that a log lacks, by trajectory and never across a contact switch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from forcegp.data.derivative import SavitzkyGolay, differentiate
from forcegp.errors import DataError
from forcegp.logs import clock, resample
from forcegp.logs.kalman import SHORTEST, smooth
from forcegp.logs.report import Report
from forcegp.logs.sections import DerivativesSection
from forcegp.logs.signals import Array, Signals, runs

UNEVEN = 0.02
"""Largest departure of a time step from the usual one, as a fraction, that passes for even."""


def even_clock(signals: Signals, period: float | None, report: Report) -> None:
    """Make the clock even where it is not, or bring it to a period.

    Args:
        signals: the log.
        period: time step asked for [s].
        report: gets how uneven the clock was.
    """
    worst = clock.unevenness(signals.t, signals.segment)
    if period is None and worst <= UNEVEN:
        return
    if worst > UNEVEN:
        report.find("uneven", f"time steps depart by up to {100.0 * worst:.3g} % from the usual step")
    resample.make_even(signals, period, report)


def complete(signals: Signals, settings: DerivativesSection, report: Report) -> Array | None:
    """Compute `qd` and `qdd` where the log has none, and pass the torque through the same filter.

    With the Savitzky–Golay filter each quantity is the derivative of the polynomial fitted to a window. The
    smoother's estimates are the means of a state-space model of each joint's position (`kalman.smooth`).

    Args:
        signals: the log, on an even clock; contact switches cut it into pieces.
        settings: method, and what to differentiate.
        report: gets the steps, and pieces that are too short.

    Returns:
        `(n, nq)` standard deviation of the computed q̈, or `None` where q̈ is logged.

    Raises:
        DataError: no piece is long enough.
    """
    logged = [name for name in ("qd", "qdd") if name in signals.vectors]
    if len(logged) == 2:
        return None
    least = settings.window if settings.method == "savitzky_golay" else SHORTEST
    piece = _pieces(signals, least, report)
    std = np.empty_like(signals.vectors["q"])
    for name in ("qd", "qdd"):
        if name not in logged:
            signals.vectors[name] = np.empty_like(std)
    for joint in range(len(signals.joint_names)):
        if settings.method == "savitzky_golay":
            _filter(signals, piece, joint, settings, std, logged)
        else:
            _smooth(signals, piece, joint, settings, std, logged)
    if "qdd" in logged:
        report.did(f"computed qd by {_named(settings)}")
        return None
    report.did(f"computed {'qdd' if logged else 'qd and qdd'} by {_named(settings)}")
    if settings.filter_torque:
        report.did("passed the torque through the same filter")
    return std


def _named(settings: DerivativesSection) -> str:
    if settings.method == "smoother":
        return "a Kalman (RTS) smoother with white snap"
    return f"a Savitzky-Golay filter of window {settings.window} and order {settings.order}"


def _pieces(signals: Signals, least: int, report: Report) -> NDArray[np.int64]:
    """Number of the piece of each row; pieces too short for the filter are dropped."""
    flags = list(signals.contact.values())
    keep = np.ones(len(signals), dtype=bool)
    for rows in signals.runs(*flags):
        keep[rows] = rows.stop - rows.start >= least
    if not keep.any():
        raise DataError(
            "no stretch of the log is long enough to compute accelerations",
            expected=f"{least} rows without a contact switch",
            got=f"{len(signals)} rows, cut by the clock and by contact switches",
        )
    if not keep.all():
        message = f"{(~keep).sum()} rows in stretches shorter than {least} rows were dropped"
        report.find("short", message, signals.row[~keep])
        # What lies on two sides of dropped rows is not one trajectory.
        signals.segment = signals.segment + np.cumsum(np.concatenate([[False], keep[1:] & ~keep[:-1]]))
        signals.keep(keep)
    piece = np.zeros(len(signals), dtype=np.int64)
    for number, rows in enumerate(signals.runs(*signals.contact.values())):
        piece[rows] = number
    return piece


def _filter(
    signals: Signals,
    piece: NDArray[np.int64],
    joint: int,
    settings: DerivativesSection,
    std: Array,
    logged: list[str],
) -> None:
    """One joint by Savitzky–Golay."""
    method = SavitzkyGolay(settings.window, settings.order)
    vectors, one = signals.vectors, slice(joint, joint + 1)
    from_velocity = "qd" in logged and settings.source != "position"
    if "qd" not in logged:
        vectors["qd"][:, one], _ = differentiate(signals.t, vectors["q"][:, one], piece, method, 1)
    if "qdd" not in logged:
        of, degree = ("qd", 1) if from_velocity else ("q", 2)
        vectors["qdd"][:, one], std[:, one] = differentiate(
            signals.t, vectors[of][:, one], piece, method, degree
        )
        if settings.filter_torque:
            filtered(vectors["tau"][:, joint], piece, method)


def filtered(values: Array, piece: NDArray[np.int64], method: SavitzkyGolay) -> None:
    """Replace a column by its Savitzky–Golay fit, piece by piece."""
    from scipy.signal import savgol_filter

    for rows in runs(piece):
        values[rows] = savgol_filter(values[rows], method.window, method.order, mode="interp")


def _smooth(
    signals: Signals,
    piece: NDArray[np.int64],
    joint: int,
    settings: DerivativesSection,
    std: Array,
    logged: list[str],
) -> None:
    """One joint by the Kalman smoother, the torque by the same one."""
    vectors = signals.vectors
    also = vectors["tau"][:, joint] if settings.filter_torque and "qdd" not in logged else None
    result = smooth(signals.t, vectors["q"][:, joint], piece, also)
    if "qd" not in logged:
        vectors["qd"][:, joint] = result.velocity
    if "qdd" not in logged:
        vectors["qdd"][:, joint], std[:, joint] = result.acceleration, result.acceleration_std
        if result.also is not None:
            vectors["tau"][:, joint] = result.also


def impact_mask(signals: Signals, margin: float) -> dict[str, NDArray[np.bool_]]:
    """Rows near a switch of each contact, where accelerations are those of an impact or one-sided fits.

    Args:
        signals: the log.
        margin: time on either side of a switch [s].

    Returns:
        name → `(n,)` bool.
    """
    masks = {}
    for name, closed in signals.contact.items():
        mask = np.zeros(len(signals), dtype=bool)
        for rows in signals.runs():
            t, own = signals.t[rows], closed[rows]
            # The switch lies between the last row of one state and the first row of the other.
            for at in t[1:][own[1:] != own[:-1]]:
                mask[rows] |= np.abs(t - at) <= margin
        masks[name] = mask
    return masks
