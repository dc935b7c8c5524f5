"""Proposal of a mapping (`--guess`) based on headings, magnitudes and the dynamics of the robot.

Units and signs are inferred by comparing the logged velocity with the derivative of the position, and the
logged torque with the inverse dynamics of the robot in the scene. Uncertain entries are marked CHECK.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.data.derivative import cross_validated_window
from forcegp.data.fields import MOST_RADIANS
from forcegp.errors import DataError
from forcegp.forces.term import NEAR_REST
from forcegp.guards import foreign
from forcegp.logs import units
from forcegp.logs.base import add_imu
from forcegp.logs.clock import even_clock
from forcegp.logs.closed import closed_by_force
from forcegp.logs.compensated import restore, subtracted
from forcegp.logs.contact import multipliers
from forcegp.logs.gather import gather
from forcegp.logs.headings import find_base, find_families, find_time, find_wrench, tokens
from forcegp.logs.mapping import (
    ROWS,
    Compensated,
    ContactStateSection,
    Draft,
    Family,
    parse_mapping,
    quoted,
)
from forcegp.logs.motion import TURNS, wrapped
from forcegp.logs.readers import read
from forcegp.logs.smoothing import add_derivatives
from forcegp.logs.table import Array, ImportReport, LogTable, Progress, Signals, Stream
from forcegp.robot import RobotModel
from forcegp.robot.free_base import BASE_JOINTS
from forcegp.robust import level_and_spread
from forcegp.rows import runs

TRIED_ROWS = 3000
"""Maximum number of rows on which the inverse dynamics are evaluated."""
BEYOND_LIMIT = 3.0
"""Multiple of a joint limit that angles in radians do not reach."""
DETERMINED = 10.0
"""Standard errors, of independent samples, from which a torque follows the inverse dynamics."""
LACKING = 0.3
"""Share of gravity below which torques are taken for compensated. Seven real logs have 0.55 to 2.1, as their
masses differ from the robot file's; a simulated arm has 1.05, and −0.003 if its driver subtracts gravity."""
UNRELATED = 0.1
"""Mean squared correlation up to which torques do not follow the inverse dynamics."""
LEAST_DEGREES = 3.2
"""If no position exceeds this value, the unit is not degrees, since the arm would hardly move [°]."""
CLEARER, NEAR = 1.5, 1.3
"""Factor by which torques must fit better for a unit to be certain; tolerance for the ratio of two units."""
TRAJECTORY, LONGEST, LEAST_FORCE = 10, 0.06, 1.0
"""Least ratio of trajectory to window; longest window (dry friction is sharp) [s]; least force [N]."""


def guess_mapping(path: str | Path, system: ConstrainedSystem, progress: Progress | None = None) -> Draft:
    """Propose a mapping for a log, with empty entries for a position or torque that is not recognised."""
    table = read(path, rows=ROWS, progress=progress)
    draft = Draft(str(path), remarks=table.remarks)
    with foreign(str(path), "a log that can be imported"):
        table = find_base(table, system.robot, draft)
        stream = find_time(table, draft)
        based = BASE_JOINTS if "base" in draft.further else ()
        joints = tuple(joint for joint in system.robot.joint_names if joint not in based)
        find_families(stream, joints, draft)
        find_wrench(table, system.robot, draft)
        possible = (
            _position_units(stream, draft, system.robot, joints) if draft.families["position"].columns else []
        )
        for quantity, family in draft.families.items():
            if draft.incomplete and not family.unit:
                family.unit = possible[0] if quantity == "position" and possible else units.SI[quantity]
                text = f"the unit {family.unit} was assumed"
                draft.say(quantity, text, doubt=len(possible) != 1 or quantity != "position")
            family.unit = family.unit or units.SI[quantity]
        _find_wraps(stream, draft, possible)
        _find_missing(stream, draft)
        if draft.incomplete:
            return draft
        _try(path, draft, system, possible)
        propose_contacts(table, draft, system, cache(lambda: _signals(path, draft, system)))
    return draft


def _position_units(stream: Stream, draft: Draft, robot: RobotModel, joints: tuple[str, ...]) -> list[str]:
    """Return the units of the positions that their values and the joint limits permit, likeliest first."""
    family = draft.families["position"]
    if family.declared and family.unit is not None:
        return [family.unit]
    columns = draft.columns_of("position", joints)
    reach = np.array([np.nanmax(np.abs(stream.columns[columns[joint]])) for joint in joints])
    draft.say("position", f"values up to {reach.max():.4g}")
    limit = torch.maximum(robot.lower.abs(), robot.upper.abs()).numpy()
    limit = limit[np.isin(robot.joint_names, joints)]
    limit = np.where(np.isfinite(limit), limit, MOST_RADIANS)
    beyond = reach > BEYOND_LIMIT * limit
    if reach.max() > MOST_RADIANS or beyond[reach.argmax()]:
        k = int(reach.argmax())
        text = f"values of {joints[k]} up to {reach[k]:.4g} exceed {limit[k]:.3g} rad: degrees"
        draft.say("position", text, doubt=bool(np.radians(reach[k]) > BEYOND_LIMIT * limit[k]))
        return ["deg"]
    return ["rad"] + ["deg"] * (not reach.max() < LEAST_DEGREES)


def _find_wraps(stream: Stream, draft: Draft, possible: list[str]) -> None:
    """Propose to make angles continuous that jump by one turn."""
    family = draft.families["position"]
    for unit in [unit for unit in possible if unit in TURNS]:
        jumps = {
            c: int(wrapped(stream.columns[c][:, None], TURNS[unit]).sum()) for c in family.columns.values()
        }
        if listing := ", ".join(f"{column} ({count})" for column, count in jumps.items() if count):
            family.unwrap = True
            if not family.declared:
                possible[:] = [unit]
            text = f"angles jump by one turn ({unit}) and are made continuous: {listing}"
            return draft.say("position", text, doubt=True)


def _find_missing(stream: Stream, draft: Draft) -> None:
    """Propose to drop rows that lack a value, such as messages of another node on the same topic."""

    def lacking(family: Family) -> NDArray[np.bool_]:
        values = np.stack([stream.columns[column] for column in family.columns.values()], axis=1)
        return np.asarray(~np.isfinite(values).all(axis=1))

    for name in ("velocity", "acceleration"):
        if name in draft.families and lacking(draft.families[name]).mean() > 0.5:
            del draft.families[name]
            draft.say("position", f"most rows lack a value of the {name}, which is computed", doubt=True)
    masks = [lacking(family) for family in draft.families.values() if family.columns]
    if masks and (bad := np.any(masks, axis=0)).any():
        draft.time["missing"] = "drop"
        draft.say("time", f"{bad.sum()} of {len(bad)} rows lack a value and are dropped", doubt=True)


def _try(path: str | Path, draft: Draft, system: ConstrainedSystem, possible: list[str]) -> None:
    """Read the log according to the draft, and infer units and the sign of the torque from the values."""
    fits = {}
    for unit in possible:
        draft.families["position"].unit = unit
        _, correlation = torque_slopes(_signals(path, draft, system, without="velocity"), system)
        fits[unit] = float((correlation**2).mean())
    # The second unit must fit clearly better than the first.
    best = max(fits, key=lambda unit: fits[unit] * (CLEARER if unit == possible[0] else 1.0))
    draft.families["position"].unit = best
    if len(fits) > 1:
        listing = ", ".join(f"{fit:.2f} in {unit}" for unit, fit in fits.items())
        doubt = fits[best] < CLEARER * min(fits.values())
        draft.say("position", f"mean squared correlation of the torque with the model: {listing}", doubt)
    if "velocity" in draft.families:
        _velocity_unit(draft, _signals(path, draft, system))
    trial = _signals(path, draft, system)
    _window(draft, trial)
    _torque(draft, trial, system)


def _window(draft: Draft, trial: Signals) -> None:
    """Choose a filter window for the noise in the longest trajectory, narrow enough for dry friction."""
    rows = max(runs(trial.segment), key=lambda rows: rows.stop - rows.start)
    names = ["q", *(["qd"] if "velocity" in draft.families else [])]
    samples, most = [trial.vectors[name][rows] for name in names], (rows.stop - rows.start) // TRAJECTORY
    asked = cross_validated_window(samples, most=most)
    period = float(np.median(np.diff(trial.t[rows])))
    most = int(LONGEST / period * (1.0 + 1e-9))
    draft.window = max(draft.window, min(asked, most - (most + 1) % 2))
    text = f"window of {1e3 * period * draft.window:.3g} ms (at most 60, or 11 samples): "
    draft.say("derivatives", f"{text}cross-validation asks for {asked} samples")


def _signals(path: str | Path, draft: Draft, system: ConstrainedSystem, without: str = "") -> Signals:
    """Return the complete rows of a log read with a draft, omitting one quantity and adding accelerations."""
    families = {name: family for name, family in draft.families.items() if name != without}
    further = {name: table for name, table in draft.further.items() if not name.startswith("contact")}
    toml = replace(draft, time=draft.time | {"missing": "drop"}, families=families, further=further).toml()
    mapping, report = parse_mapping(toml.encode(), "proposed mapping"), ImportReport(str(path))
    signals = gather(path, mapping, system.robot, report, rows=ROWS)
    even_clock(signals, None, report)
    settings = mapping.sections.derivatives.model_copy(update={"source": "position"})
    std = add_derivatives(signals, settings, report)
    add_imu(signals, std, system.robot, mapping, report)
    restore(signals, system.robot, mapping, report)
    return signals


def _velocity_unit(draft: Draft, trial: Signals) -> None:
    """Infer the unit and sign of the velocity from its slope against the derivative of the position."""
    family = draft.families["velocity"]
    articulated = _articulated(draft, trial)
    q, qd = trial.vectors["q"][:, articulated], trial.vectors["qd"][:, articulated]
    inner = np.flatnonzero(trial.segment[2:] == trial.segment[:-2]) + 1
    rate = (q[inner + 1] - q[inner - 1]) / (trial.t[inner + 1] - trial.t[inner - 1])[:, None]
    slopes = (rate * qd[inner]).sum(axis=0) / np.maximum((rate**2).sum(axis=0), 1e-300)
    moving = rate.std(axis=0) > 0.05 * rate.std(axis=0).max()
    slope = float(np.median(slopes[moving]))
    current = units.VELOCITY[family.unit or "rad/s"]
    ratios = {u: 1.0 / units.VELOCITY[u] for u in ("rad/s", "deg/s", "rpm", "rev/s", "mrad/s")}
    unit = min(ratios, key=lambda u: abs(np.log(ratios[u]) - np.log(max(abs(slope / current), 1e-12))))
    miss = abs(slope) / current / ratios[unit]
    if (time := _time_unit(draft, abs(slope))) is not None:
        text = f"the velocity is {slope:.3g} times the derivative of the position: time is in {time}, not"
        draft.say("time", f"{text} {draft.time['unit']}", doubt=True)
        draft.time["unit"], unit, miss, slope = time, family.unit or "rad/s", 1.0, slope / abs(slope)
    if family.declared and unit != family.unit:
        text = f"{family.unit} is declared; it is {slope:.3g} times the derivative of q"
        draft.say("velocity", text, doubt=True)
    elif not 1.0 / NEAR < miss < NEAR:
        draft.say("velocity", f"the velocity is {slope:.3g} times the derivative of the position", doubt=True)
    else:
        family.unit = unit
        draft.say("velocity", f"{unit}: {slope:.3g} times the derivative of the position in rad/s")
    family.sign = _signs(slopes, moving, np.array(trial.joint_names)[articulated])
    if family.sign != 1.0:
        turned = "all joints" if family.sign == -1.0 else "some joints"
        draft.say("velocity", f"the velocity of {turned} is minus the derivative of the position", doubt=True)


def _time_unit(draft: Draft, slope: float) -> str | None:
    """Return the unit of time with which a velocity in rad/s, or in its declared unit, is the derivative of
    the position, if it is not the unit in the draft.
    """
    unit = draft.time["unit"]
    if not isinstance(unit, str) or not slope > 0.0:
        return None
    off = {u: slope * units.TIME[u] / units.TIME[unit] for u in units.TIME}
    best = min(off, key=lambda u: abs(np.log(off[u])))
    return best if best != unit and 1.0 / NEAR < off[best] < NEAR else None


def _articulated(draft: Draft, trial: Signals) -> NDArray[np.bool_]:
    """Return the mask (nq,) of the joints with columns of their own, other than those of a free base."""
    return ~np.isin(trial.joint_names, BASE_JOINTS if "base" in draft.further else ())


def _signs(slopes: Array, clear: np.ndarray, joints: NDArray[np.str_]) -> float | dict[str, float]:
    """Return one sign for all joints, or one per joint if they differ."""
    negative = slopes[clear] < 0.0
    if negative.all() and clear.any():
        return -1.0
    if not negative.any():
        return 1.0
    return {str(j): -1.0 if c and s < 0.0 else 1.0 for j, s, c in zip(joints, slopes, clear, strict=True)}


def _torque(draft: Draft, trial: Signals, system: ConstrainedSystem) -> None:
    """Infer the sign and unit of the torque by comparing it with the inverse dynamics."""
    family, articulated = draft.families["torque"], _articulated(draft, trial)
    joints = np.array(trial.joint_names)[articulated]
    slopes, correlation = (x[articulated] for x in torque_slopes(trial, system))
    clear = np.abs(correlation) > 0.5
    listing = ", ".join(f"{j} {c:+.2f}" for j, c in zip(joints, correlation, strict=True))
    draft.say("torque", f"correlation with the robot's inverse dynamics: {listing}")
    named = {"current", "currents"}.intersection(tokens(family.pattern))
    if current := family.unit in units.CURRENT or (bool(named) and not family.declared):
        family.unit = family.unit if family.declared else "A"
        text = "a current: give the gear ratio and the torque constant [N m/A]; a fit learns its error"
        draft.say("torque", text, doubt=True)
    measured = len(clear) - len(family.unmeasured)
    if (share := gravity_share(trial, system)) < LACKING:
        lighter, follows = (x[articulated] for x in torque_slopes(trial, system, "gravity"))
        if (np.abs(follows) > 0.5).sum() >= min(clear.sum(), 0.5 * measured):
            slopes, clear, family.compensated = lighter, np.abs(follows) > 0.5, "gravity"
            text = (
                f"the torque has {max(share, 0.0):.0%} of the gravity load: the driver seems to subtract it"
            )
            draft.say("torque", text, doubt=True)
    if clear.sum() < 0.5 * measured:
        return _remainder(draft, trial, correlation)
    family.sign = _signs(slopes, clear, joints)
    if isinstance(family.sign, dict):
        draft.say("torque", "the sign differs between joints; are the joints in the right order?", doubt=True)
    elif clear.sum() < len(clear) - len(family.unmeasured):
        draft.say("torque", f"the sign is that of {clear.sum()} of {len(clear)} joints", doubt=True)
    size = float(np.median(np.abs(slopes[clear])))
    if not family.declared and not current and 1000.0 / NEAR**2 < size < 1000.0 * NEAR**2:
        family.unit = "mNm"
        draft.say("torque", f"{size:.4g} times the inverse dynamics: taken for mNm", doubt=True)
    elif not current and not 0.5 < size < 2.0:
        draft.say("torque", f"{size:.3g} times the inverse dynamics: a current, or motor side?", doubt=True)


def _remainder(draft: Draft, trial: Signals, correlation: Array) -> None:
    """Propose `compensated = "model"` for torques that friction explains, and their sign: drives push."""
    family, articulated = draft.families["torque"], _articulated(draft, trial)
    qd, tau = trial.vectors["qd"][:, articulated], trial.vectors["tau"][:, articulated]
    work, explained = np.zeros(qd.shape[1]), np.zeros(qd.shape[1])
    for i in range(qd.shape[1]):
        columns = np.column_stack([np.ones(len(qd)), qd[:, i], np.tanh(qd[:, i] / NEAR_REST)])
        weights = np.linalg.lstsq(columns, tau[:, i], rcond=None)[0]
        friction = columns[:, 1:] @ weights[1:]
        work[i] = float((friction * qd[:, i]).sum())
        spread = float(np.var(tau[:, i]))
        explained[i] = 1.0 - float(np.var(tau[:, i] - columns @ weights)) / spread if spread > 0.0 else 0.0
    few = (explained > 0.5).sum() < 0.5 * (len(work) - len(family.unmeasured))
    if few or (correlation**2).mean() > UNRELATED:
        return draft.say("torque", "few torques follow the inverse dynamics: sign unknown", doubt=True)
    family.sign = _signs(work, explained > 0.5, np.array(trial.joint_names)[articulated])
    family.compensated = "model"
    draft.say("torque", "friction explains it: the driver seems to subtract a model", doubt=True)


def torque_slopes(
    trial: Signals, system: ConstrainedSystem, compensated: Compensated | None = None
) -> tuple[Array, Array]:
    """Return the slope (nq,) of the logged torque over inverse dynamics, and the partial correlation (nq,).

    If the torque is `compensated`, inverse dynamics lack what the driver subtracts.

    For each joint, τ_log = k τ_rigid + v q̇ + f sign(q̇) + Aᵀλ + const is fitted by least squares, with a
    constant λ for each contact. The partial correlation is that of τ_log and τ_rigid given the other terms.
    """
    names = ("model",) if compensated is None else ("model", compensated)
    slopes, correlation = np.zeros(system.robot.nq), np.zeros(system.robot.nq)
    for i, (tau, *rigid) in enumerate(_beside_friction(trial, system, names)):
        x = rigid[0] if compensated is None else rigid[0] - rigid[1]
        if (power := float(x @ x)) > 0.0 and (size := float(tau @ tau)) > 0.0:
            slopes[i], correlation[i] = x @ tau / power, x @ tau / np.sqrt(power * size)
    return slopes, correlation


def gravity_share(trial: Signals, system: ConstrainedSystem) -> float:
    """Return the share of the gravity torque that the logged torques contain beside the other rigid torques.

    For each joint, τ_log = k (τ_rigid + (h − 1) τ_gravity) + friction is fitted, and h averaged over the
    joints with their precisions. Without any determined k, h is 1.
    """
    shares, weights = [], []
    for tau, rigid, gravity in _beside_friction(trial, system, ("model", "gravity")):
        X = np.column_stack([rigid - gravity, gravity])
        if np.linalg.matrix_rank(X) < 2:
            continue
        inverse = np.linalg.inv(X.T @ X)
        k, kh = inverse @ (X.T @ tau)
        variance = float(np.var(tau - X @ [k, kh])) * np.diag(inverse)
        if abs(k) > DETERMINED * np.sqrt(variance[0]):
            shares.append(kh / k)
            weights.append(k**2 / max(float(variance[1]), 1e-300))
    return float(np.average(shares, weights=weights)) if shares else 1.0


def _beside_friction(
    trial: Signals, system: ConstrainedSystem, names: Sequence[Compensated]
) -> Iterator[tuple[Array, ...]]:
    """Yield for each joint the torque and the named rigid torques less their fits by friction and contact."""
    rows = np.linspace(0, len(trial) - 1, min(TRIED_ROWS, len(trial))).astype(int)
    q, qd, qdd, tau = (np.ascontiguousarray(trial.vectors[name][rows]) for name in ("q", "qd", "qdd", "tau"))
    torques = [tau, *(subtracted(system.robot, name, q, qd, qdd) for name in names)]
    A = system.equations(torch.from_numpy(q), torch.from_numpy(qd)).A.numpy()
    for i in range(system.robot.nq):
        others = np.column_stack([np.ones(len(rows)), qd[:, i], np.sign(qd[:, i]), A[:, :, i]])
        each = np.column_stack([torque[:, i] for torque in torques])
        yield tuple((each - others @ np.linalg.lstsq(others, each, rcond=None)[0]).T)


def propose_contacts(
    log: LogTable, draft: Draft, system: ConstrainedSystem, signals: Callable[[], Signals]
) -> None:
    """Add a proposed source for the state of each contact in the scene to a draft, based on `signals`."""
    named = [(c, x) for s in log.streams for c, x in s.columns.items() if "contact" in c.lower()]
    flags = [name for name, x in named if np.isin(x, (0.0, 1.0)).all()]
    in_order = flags if len(system.contacts) in (1, len(flags)) else []
    forces = cache(lambda: multipliers(signals(), system))
    for number, contact in enumerate(system.contacts):
        name, table = contact.name, f"contact.{quoted(contact.name)}"
        column = next((c for c in flags if name in c), next(iter(in_order[number:]), None))
        if column is not None:
            draft.further[table] = {"source": "column", "column": column}
            if name not in column and len(flags) > 1:
                draft.say(table, "contacts were taken in the order of the columns", doubt=True)
        elif "wrench" in draft.further or not isinstance(contact, SurfaceContact):
            draft.further[table] = {"source": "wrench" if "wrench" in draft.further else "always"}
        else:
            source, reason = _state(signals(), forces()[name], name)
            draft.further[table] = {"source": source}
            draft.say(table, f"no contact column; {reason}", doubt=True)
            draft.say(table, "source may also be multiplier, distance, always or never")


def _state(signals: Signals, values: Array, name: str) -> tuple[str, str]:
    """Return the source of a contact's state according to λ and the motion (n, 3), and the reason."""
    force, section = values[:, 0], ContactStateSection(source="multiplier")
    middle, spread = level_and_spread(force)
    try:
        _, high, low, source = closed_by_force(signals, force, name, section, values[:, 1:])
    except DataError:
        source = "always" if middle > max(2.0 * spread, LEAST_FORCE) else "never"
        return source, f"λ of the rigid body shows one state, {middle:.3g} ± {spread:.2g} N"
    also = source.removeprefix("multiplier")
    return "multiplier", f"λ of the rigid body{also} shows two states, parted at {low:.3g} to {high:.3g} N"
