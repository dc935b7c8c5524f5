"""Checks of individual columns for implausible values, wrapped angles and jumps in the state."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import maximum_filter1d

from forcegp import dynamics
from forcegp.checks.excitation import still_joints
from forcegp.checks.finding import at_rows
from forcegp.checks.log import DEPARTURE, Array, Log, Outcome, recomputed, spikes
from forcegp.constraints import ConstrainedSystem
from forcegp.data.clipped import limits_of
from forcegp.data.fields import JOINT_VECTORS, resolution
from forcegp.robust import robust_std
from forcegp.rows import intervals, repeats

HELD_RUN = 2
"""Minimum number of repeated rows for which the logger is reported to have missed updates."""
STUCK_SECONDS, STUCK_VISIBLE = 0.05, 0.02
"""Duration for which a stuck channel repeats a value [s]; fraction of its range by which it should move."""
SPIKE, SPIKE_ALONE = 12.0, 4.0
"""Deviation of a spike in robust standard deviations, which noise never reaches; ratio to its neighbours'."""
SPIKE_SHAPE, SPIKE_NOISE = 0.2, 4.0
"""Tolerance for the neighbours' deviations, as a fraction of a spike and in robust standard deviations."""
SPIKE_SHARED, DRIVEN = 0.05, 0.5
"""A value is not a spike if another channel deviates by this fraction of it (by the second fraction, if it
exceeds that channel's range), or if a torque step explains the second fraction of a deviating
acceleration."""
FEWEST = 50
"""Minimum number of values for estimating a scale."""
SPIKE_VISIBLE = (0.01, 0.002)
"""Minimum size of a spike, as a fraction of its column's range and of the largest range among the joints."""
COARSE = 0.05
"""Fraction of the velocity that noise from encoder steps may reach when positions are differentiated."""


def logged(log: Log) -> dict[str, Array]:
    """Return the joint vectors that were logged rather than derived."""
    return {name: getattr(log, name) for name in JOINT_VECTORS if name not in log.derived}


def check_finite(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find NaN and infinite values."""
    bad = ~np.isfinite(log.t)
    columns = ["t"] if bad.any() else []
    for name, value in logged(log).items():
        wrong = ~np.isfinite(value)
        columns += [f"{name}.{log.joint_names[j]}" for j in np.flatnonzero(wrong.any(axis=0))]
        bad = bad | wrong.any(axis=1)
    listed = ", ".join(columns[:4]) + (" and others" if len(columns) > 4 else "")
    text = f"{int(bad.sum())} rows hold a NaN or an infinite value, in {listed}:"
    return at_rows(bad, "not-finite", text, rows=bad.sum()), log


def check_held(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find rows in which all channels repeat their values while the arm moves."""
    held = repeats(*logged(log).values()) & np.append(False, np.diff(log.segment) == 0)
    held &= np.abs(log.qd).max(axis=1) > 0.0
    if held.sum() < HELD_RUN:
        return [], log
    text = f"{int(held.sum())} rows ({100 * held.mean():.2g} %) repeat the one before:"
    return at_rows(held, "rows-held", text, rows=held.sum(), share=held.mean()), log.mask(held)


def check_stuck(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find channels that stay constant although the joint moves."""
    if not np.isfinite(log.dt):
        return [], log
    least, findings, bad = max(5, round(STUCK_SECONDS / log.dt)), [], np.zeros(len(log), bool)
    still = still_joints(log)
    for name, value in logged(log).items():
        visible = STUCK_VISIBLE * log.reach(name)
        for j, joint in enumerate(log.joint_names):
            x = value[:, j]
            steps = np.abs(np.diff(x))
            if (steps > 0.0).mean() < 0.1 or (still[j] and name != "tau"):
                continue
            runs, same = np.zeros(len(log), bool), (steps == 0.0) & log.usable[1:] & log.usable[:-1]
            for a, b in intervals(same, least=least):
                # A torque that stays at its extreme is clipped, which is another finding.
                clips = name == "tau" and x[a] in limits_of(x[log.usable])
                runs[a : b + 1] = not clips and _expected_change(log, name, j, a, b) > visible[j]
            text = f"{name}.{joint} keeps one value while the arm moves, in"
            findings += at_rows(runs, "channel-stuck", text, (joint,))
            bad |= runs
    return findings, log.mask(bad) if findings else log


def _expected_change(log: Log, name: str, j: int, a: int, b: int) -> float:
    """Return the expected change of a channel between rows a and b, given the joint's other channels."""
    if name in ("q", "qd"):
        rate = log.qd if name == "q" else log.qdd
        return float(np.ptp(np.cumsum(rate[a:b, j])) * log.dt)
    # Torque and acceleration: as far as they change over as many rows elsewhere, if the arm moves, for the
    # torque, or the joint itself, for the acceleration.
    x, moved = getattr(log, name)[:, j], log.q[a:b] if name == "tau" else log.q[a:b, j : j + 1]
    lag = b - a
    usual = float(np.median(np.abs(x[lag:] - x[:-lag])))
    return usual if np.abs(np.diff(moved, axis=0)).max(initial=0.0) > 0.0 else 0.0


def check_spikes(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find isolated values far from the curve through their neighbours."""
    bad, hit = np.zeros(len(log), bool), []
    departures = {name: _departures(log, value) for name, value in logged(log).items()}
    near = np.zeros(len(log), bool)
    for label in log.contact.values():  # next to a contact switch values jump by nature
        near[1:] |= label[1:] != label[:-1]
    for name, (departure, around, scale) in departures.items():
        reach = log.reach(name)
        least = np.maximum(SPIKE_VISIBLE[0] * reach, SPIKE_VISIBLE[1] * reach.max())
        outlier = (
            ~_within_two(near)[:, None]
            & (np.abs(departure) > np.maximum(SPIKE * scale, least))
            & (np.abs(departure) > SPIKE_ALONE * around)
            & _one_value(departure, scale)
            & ~_shocks(log, departures, name)
        )
        if name == "qdd" and "tau" in departures:
            outlier &= ~_driven(system, log, departure, outlier)
        # The neighbours of a spike are off as well, by less.
        peak = outlier & (np.abs(departure) >= _within_two(np.abs(departure)))
        bad |= peak.any(axis=1)
        hit += [(name, joint) for joint in log.named(peak.any(axis=0))]
    count = int(bad.sum())
    text = f"{count} isolated outlier{'s' * (count > 1)} in {', '.join(map('.'.join, hit[:4]))}:"
    joints = tuple(dict.fromkeys(joint for _, joint in hit))
    return at_rows(bad, "spike", text, joints, rows=bad.sum()), log.mask(bad)


def _departures(log: Log, value: Array) -> tuple[Array, Array, Array]:
    """Return the deviations (n, nq) of values and of their neighbours, and the usual scale (nq,)."""
    departure, around = np.zeros_like(value), np.zeros_like(value)
    for s in log.stretches:
        departure[s], around[s] = spikes(value[s])
    inner = departure[log.usable]
    if len(inner) < FEWEST:
        return departure, around, np.full(value.shape[1], np.inf)
    scale = robust_std(inner) + resolution(value[log.usable]) + 1e-12 * np.abs(value[log.usable]).max()
    return departure, around, scale


def _shocks(log: Log, departures: dict[str, tuple[Array, Array, Array]], name: str) -> np.ndarray:
    """Return a mask (n, nq) of values other than positions that deviate together with other channels."""
    departure = departures[name][0]
    if name == "q":
        return np.zeros(departure.shape, bool)
    pair = ("tau", "qdd") if name in ("tau", "qdd") else (name,)
    size = {key: _size(log, key, *departures[key]) for key in pair if key in departures}
    confirmed = np.zeros(departure.shape, bool)
    for j, size_j in enumerate(size[name].T):
        others = [np.delete(part, j, axis=1) if key == name else part for key, part in size.items()]
        most = np.concatenate(others, axis=1).max(axis=1, initial=0.0)
        confirmed[:, j] = most > size_j * np.where(size_j < 1.0, SPIKE_SHARED, DRIVEN)
    return confirmed


def _driven(system: ConstrainedSystem, log: Log, departure: Array, outlier: np.ndarray) -> np.ndarray:
    """Return a mask (n, nq) of accelerations caused by a torque step at the joint, Δτ_j (M⁻¹)_jj."""
    step = np.pad(np.abs(np.diff(log.tau, axis=0)), ((1, 1), (0, 0)))
    step, driven = np.maximum(step[:-1], step[1:]), np.zeros_like(outlier)
    rows = np.flatnonzero(outlier.any(axis=1))
    if len(rows):
        M = dynamics.mass_matrix(system.robot, log.tensors(rows, "q")[0])
        inverse = torch.linalg.inv(M).diagonal(dim1=-2, dim2=-1).detach().numpy()
        driven[rows] = step[rows] * inverse > DRIVEN * np.abs(departure[rows])
    return driven


def _size(log: Log, name: str, departure: Array, around: Array, scale: Array) -> Array:
    """Return the largest deviation within two rows, relative to the range, or zero if it may be noise."""
    size, reach = np.abs(departure), log.reach(name)
    return _within_two(np.where(size > SPIKE * scale, size / np.maximum(reach, 1e-300), 0.0))


def _one_value(departure: Array, scale: Array) -> np.ndarray:
    """Return the mask (n, d) of deviations h next to −4h/6 and h/6, which a kink does not cause."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(departure, ((2, 2), (0, 0))), 5, axis=0)
    misfit = np.abs(around - departure[..., None] * DEPARTURE).max(axis=-1)
    return misfit <= SPIKE_SHAPE * np.abs(departure) + SPIKE_NOISE * scale


def _within_two(x: Array) -> Array:
    """Return the largest value within two rows."""
    return maximum_filter1d(x, 5, axis=0, mode="constant")


def check_resolution(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find encoder steps so coarse that they add too much noise to differentiated positions."""
    q = log.q[log.usable]
    if len(q) < FEWEST:
        return [], log
    step = resolution(q)
    # A step Δ is noise of Δ/√12; the difference of two samples over dt has √2 of it.
    noise = step / np.sqrt(6.0) / log.dt
    speed = np.sqrt(np.mean(log.qd[log.usable] ** 2, axis=0))
    coarse = (noise > COARSE * speed) & (step > 0.0)
    worst = int(np.argmax(np.where(coarse, noise / np.maximum(speed, 1e-300), 0.0)))
    text = (
        f"positions come in steps of {step[worst]:.3g} rad ({log.joint_names[worst]}), which add noise of "
        f"{noise[worst]:.3g} rad/s to a velocity from neighbouring samples"
    )
    joints = log.named(coarse)
    return [log.finding("quantised", text, joints, step=step[worst])] if joints else [], log


JUMP, FASTEST = 30.0, 2.0
"""A jump exceeds this many robust standard deviations of the steps (15 at each of two rows), and it exceeds
the change of the fastest joint within a step by this factor."""


def _jumps(log: Log, value: str, derivative: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the mask (n,) of rows at which a column jumps, and the joints; none for derived columns."""
    x, rate, usable = getattr(log, value), getattr(log, derivative), log.usable
    if log.derived & {value, derivative}:
        return np.zeros(len(log), bool), ()
    surplus = np.zeros_like(x)
    for s in log.stretches:  # what the rate does not account for
        mean = 0.5 * (rate[s][1:] + rate[s][:-1])
        surplus[s][1:] = np.diff(x[s], axis=0) - mean * np.diff(log.t[s])[:, None]
    rounding = np.finfo(float).eps * np.abs(x[usable]).max()
    scale = robust_std(surplus[usable]) + resolution(x[usable]) + rounding
    change = np.abs(np.diff(x, axis=0, prepend=x[:1]))
    fastest = float(np.percentile(np.abs(rate[usable]), 99.9)) * log.dt
    big = (np.abs(surplus) > JUMP * scale) & (np.abs(surplus) > FASTEST * fastest)
    # Where the column itself does not change faster than usual, its rate is at fault, not the position.
    jumps = big & (change > JUMP * np.median(change[usable], axis=0)) & usable[:, None]
    return np.asarray(jumps.any(axis=1)), log.named(jumps.any(axis=0))


TURN, SMOOTH = 2.0 * np.pi, 3.0
"""Full turn [rad]; ratio to the fastest usual change within which a change is smooth but for full turns."""


def check_wrapped(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find angles that jump by full turns since they are confined to an interval of one turn."""
    steps, linked = np.diff(log.q, axis=0), log.finite[1:] & log.finite[:-1]
    forward = np.diff(log.t)
    linked &= (forward > 0.0) & (forward <= log.longest_step)  # an import may start a segment at each jump
    if not log.header.ordered or not linked.any():
        return [], log
    turns = np.round(np.where(linked[:, None], steps, 0.0) / TURN)
    rest = np.abs(steps - TURN * turns)
    confined = np.ptp(log.q[log.finite], axis=0) <= TURN * (1.0 + 1e-3)
    revolute = system.robot.revolute.cpu().numpy() > 0.0
    turns *= (rest <= SMOOTH * np.quantile(rest[linked], 0.99, axis=0)) & confined & revolute
    at = np.append(False, turns.any(axis=1))
    joints = log.named(turns.any(axis=0))
    findings = at_rows(
        at, "angle-wrapped", f"the position of {', '.join(joints)} jumps by a full turn at", joints
    )
    return findings, _unwrapped(system, log, turns, at) if findings else log


def _unwrapped(system: ConstrainedSystem, log: Log, turns: Array, at: np.ndarray) -> Log:
    """Return the log with continuous angles, near the middle of the joint range in each segment."""
    segment = np.append(0, np.cumsum((np.diff(log.segment) != 0) & ~at[1:]))
    q = log.q - TURN * np.append(np.zeros((1, log.nq)), np.cumsum(turns, axis=0), axis=0)
    middle = 0.5 * (system.robot.lower + system.robot.upper).cpu().numpy()
    for number in np.unique(segment):
        rows = segment == number
        away = np.nan_to_num(np.nanmedian(q[rows], axis=0) - np.where(np.isfinite(middle), middle, 0.0))
        q[rows] -= TURN * np.round(away / TURN) * turns.any(axis=0)
    return recomputed(log.replace(q=q, segment=segment))


def check_jumps(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find position jumps that the velocity does not explain, due to missing rows."""
    at, joints = _jumps(log, "q", "qd")
    findings = at_rows(at, "position-jump", f"the position of {', '.join(joints)} jumps at", joints)
    return findings, log.replace(segment=log.segment + np.cumsum(at))


def check_impacts(system: ConstrainedSystem, log: Log) -> Outcome:
    """Find impacts, at which the velocity jumps by more than the acceleration explains."""
    around, joints = _jumps(log, "qd", "qdd")
    findings = at_rows(around, "impact", "the velocity jumps, as at an impact, at", joints)
    around[:-1] |= around[1:]
    return findings, log.mask(around)
