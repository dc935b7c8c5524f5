"""Interpretation of headings: time column, families with one column per joint, units, and sensors.

Columns without headings are identified by their values.
"""

from __future__ import annotations

import re
from difflib import SequenceMatcher
from itertools import permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from forcegp.errors import MappingError
from forcegp.logs import units
from forcegp.logs.mapping import Draft, Family
from forcegp.logs.table import LogTable, Stream
from forcegp.robot import RobotModel
from forcegp.robust import robust_std

WORDS: dict[str, list[str]] = units.VOCABULARY["words"]
"""Words for each quantity, in the order in which they are tried."""
MEASURED, COMMANDED = (units.VOCABULARY["columns"][kind] for kind in ("measured", "commanded"))
"""Words for measured columns, and words for columns to avoid, such as commands."""
_TIME = re.compile(
    r"^(.*[ _./])?(t|mt|time|times|timestamp|stamp|clock|sec|secs|seconds|ms|millis|zeit)([ _./\[(].*)?$"
)
_DECLARED = re.compile(r"[\[(]([^\])]*)[\])]|_(deg|rad|ms|us|ns|s|nm|mnm|a|ma|rpm|degps|radps)$", re.I)
_AXES = (("force", "f"), ("torque", "m", "t", "moment"))
_SEGMENTS = ("segment", "episode_index", "episode", "trial", "run")


def tokens(name: str) -> list[str]:
    """Return the words of a heading in lower case, treating a derivative of q as one word.

    >>> tokens("actualJointPos_3 [deg]")
    ['actual', 'joint', 'pos', '3', 'deg']
    >>> tokens("d_d_q_3"), tokens("qDot1")
    (['ddq', '3'], ['qdot', '1'])
    """
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    words = " ".join(re.findall(r"[a-z]+|\d+", spaced.lower()))
    return re.sub(
        r"\b(?:d |dd )+(?=q\b)|\bq (?=d*dot\b)", lambda part: part[0].replace(" ", ""), words
    ).split()


def declared_unit(name: str, stream: Stream) -> str | None:
    """Return the unit declared in a heading or in the line below it, or `None`."""
    if name in stream.units:
        return units.spelled(stream.units[name])
    found = (units.spelled(match[1] or match[2] or "") for match in _DECLARED.finditer(name))
    return next((unit for unit in found if unit is not None), None)


def find_time(table: LogTable, draft: Draft) -> Stream:
    """Return the stream that contains the joint columns, and add its time column to the draft."""
    stream = max(table.streams, key=lambda s: (len(s.columns), len(s)))
    candidates = []
    for name, values in stream.columns.items():
        steps = np.diff(values[np.isfinite(values)])
        if not len(steps) or not (steps > 0.0).mean() > 0.95:
            continue
        step = float(np.median(steps[steps > 0.0]))
        even = float((np.abs(steps - step) < 0.5 * step).mean())
        named = bool(_TIME.match(name.lower())) or name == "header"
        candidates.append((2.0 * named + even + (name == "header"), name, step))
    if not candidates:
        rows = (f"{name} ({len(other)} rows)" for other in table.streams for name in other.columns)
        raise MappingError(
            f"{table.source}: no column increases like time, with {len(stream)} rows as the joints",
            expected="a column of time stamps with as many rows",
            got=", ".join(sorted(rows, key=lambda name: not _TIME.match(name)))[:300],
        )
    _, column, step = max(candidates)
    unit, doubt = declared_unit(column, stream), False
    if unit in units.TIME:
        text = f"the unit {unit} is declared; steps are {step:.6g} {unit}"
    else:
        # Robots are logged at 10 Hz to 10 kHz, so the step alone distinguishes s, ms, µs and ns.
        unit = "s" if step <= 0.1 else "ms" if step <= 100.0 else "us" if step <= 1e5 else "ns"
        text, doubt = f"steps of {step:.6g} were interpreted as {unit}", unit != "s"
    draft.say("time", text, doubt)
    for other in (s for s in table.streams if s is not stream and len(s) != len(stream)):
        stamps = [name for name in other.columns if _TIME.match(re.sub(r"\[\d+\]$", "", name.lower()))]
        if stamps and len(stamps) == len(other.columns):
            told = f"{', '.join(stamps)} was left out: {len(other)} rows, where the joints have {len(stream)}"
            draft.say("time", told, doubt=True)
    segment = next((name for name in _SEGMENTS if name in stream.columns), None)
    draft.time = {"column": column, "unit": unit, "segment": segment}
    return stream


def find_families(stream: Stream, robot: RobotModel, draft: Draft) -> None:
    """Find the columns of each quantity, and the joint names used in the log."""
    families = _families(stream, robot)
    if not any(re.search("[A-Za-z]", name) for name in stream.columns):
        find_by_values(stream, robot.joint_names, draft)
        families = []
    for quantity in WORDS:
        rated = [family for family in families if _rate(family, quantity) > 0.0]
        if rated:
            best, *others = sorted(rated, key=lambda family: -_rate(family, quantity))
            draft.families[quantity] = best
            if others:
                listing = ", ".join(family.pattern for family in others)
                draft.say(quantity, f"{best.pattern!r} was selected; also available: {listing}", doubt=True)
    for quantity in ("position", "torque"):
        if quantity not in draft.families:
            raise MappingError(
                f"{draft.source}: no columns were recognised as the {quantity} of {robot.nq} joints",
                expected=f"headings such as {WORDS[quantity][1]}_1 to {WORDS[quantity][1]}_{robot.nq}",
                got=", ".join(stream.columns)[:300],
                hint="write the mapping yourself; docs/import.md shows every key",
            )
    _match_joints(robot, draft)
    for quantity, family in draft.families.items():
        declared = {declared_unit(column, stream) for column in family.columns.values()} - {None}
        valid = [unit for unit in declared if unit in units.QUANTITY[quantity]]
        if len(valid) == 1:
            family.unit, family.declared = valid[0], True
            draft.say(quantity, f"the unit {valid[0]} is declared")


def _families(stream: Stream, robot: RobotModel) -> list[Family]:
    """Return groups of columns that differ in a joint name, a number, or the part after the first dot."""
    groups: dict[str, dict[str, str]] = {}
    names = sorted(robot.joint_names, key=len, reverse=True)
    for column in stream.columns:
        joint = next((j for j in names if j in column), None)
        if joint is not None:
            groups.setdefault(column.replace(joint, "{joint}", 1), {})[joint] = column
            continue
        for number in re.finditer(r"\d+", column):
            pattern = f"{column[: number.start()]}{{joint}}{column[number.end() :]}"
            groups.setdefault(pattern, {})[number[0]] = column
        head, dot, tail = column.partition(".")
        if dot and tail and head in ("position", "velocity", "effort"):
            groups.setdefault(f"{head}.{{joint}}", {})[tail] = column
    exact = set(robot.joint_names)
    result = []
    for pattern, columns in groups.items():
        if exact <= set(columns):
            columns = {joint: columns[joint] for joint in robot.joint_names}
        if len(columns) == robot.nq:
            result.append(Family(pattern, columns, stream.name))
    return result


def _rate(family: Family, quantity: str) -> float:
    """Return a score for how well the name of a family matches a quantity, or 0 for no match."""
    words = tokens(family.pattern.replace("{joint}", " "))
    meant = (other for other in WORDS if any(word in WORDS[other] for word in words))
    if next(meant, None) != quantity:
        return 0.0
    score = 1.0 + 0.5 * any(w in MEASURED for w in words) - 0.8 * any(w in COMMANDED for w in words)
    return score - 0.01 * len(words) - 0.2 * ("current" in words or "currents" in words)


def _match_joints(robot: RobotModel, draft: Draft) -> None:
    """Match the robot's joints to the names that the log uses for its positions."""
    names = list(draft.families["position"].columns)
    if all(name.isdigit() for name in names):
        draft.say("joints", "the log numbers its joints; they were numbered from base to tip", doubt=True)
        draft.joints = dict(zip(robot.joint_names, sorted(names, key=int), strict=True))
    elif set(names) != set(robot.joint_names):
        likeness = np.array([[_likeness(j, name) for name in names] for j in robot.joint_names])
        # Among equally similar names, the order in the log decides; the user is asked to check it.
        likeness += 0.3 * np.eye(len(names))
        rows, columns = linear_sum_assignment(-likeness)
        draft.joints = {robot.joint_names[i]: names[k] for i, k in zip(rows, columns, strict=True)}
        draft.say("joints", "the names were matched by similarity", doubt=True)
    # Numbered families whose joint names differ from those of the positions get one column per joint.
    for quantity, family in list(draft.families.items()):
        if set(family.columns) == set(names):
            continue
        if all(name.isdigit() for name in family.columns):
            columns = [family.columns[name] for name in sorted(family.columns, key=int)]
            family.by_joint = dict(zip(robot.joint_names, columns, strict=True))
            draft.say(quantity, "numbered joints were taken from base to tip", doubt=True)
        else:
            del draft.families[quantity]
            text = f"{family.pattern!r} names its joints differently and was ignored"
            draft.say("joints", text, doubt=True)


def _likeness(joint: str, name: str) -> float:
    a, b = joint.lower(), name.lower()
    numbers = re.findall(r"\d+", a) == re.findall(r"\d+", b)
    shared = len(set(tokens(a)) & set(tokens(b)))
    return shared + 0.3 * numbers + SequenceMatcher(None, a, b).ratio()


def find_wrench(table: LogTable, robot: RobotModel, draft: Draft) -> None:
    """Find the columns of a force-torque sensor, such as `force.x`, `Fx` or `f_x`."""
    for stream in table.streams:
        columns: dict[tuple[int, str], str] = {}
        for column in stream.columns:
            words = tokens(column)
            axis = words[-1][-1] if words and words[-1][-1] in "xyz" else ""
            stem = words[-1][:-1] or (words[-2] if len(words) > 1 else "")
            for part, names in enumerate(_AXES):
                if axis and stem in names:
                    columns.setdefault((part, axis), column)
        force, moment = ([columns.get((part, axis)) for axis in "xyz"] for part in range(2))
        if all(force):
            wrench = {"force": force, "stream": stream.name or None}
            wrench |= {"torque": moment if all(moment) else None, "frame": robot.frame_names[-1]}
            draft.further["wrench"] = wrench
            unknown = "the sensor's frame, its sign (acts_on) and the tool's weight are not in the log"
            draft.say("wrench", unknown, doubt=True)
            return


RELATED = 0.95
"""Minimum correlation of a velocity with the rate of change of its position."""


def find_by_values(stream: Stream, joints: tuple[str, ...], draft: Draft) -> None:
    """Propose families for columns without headings: blocks of one column per joint, and their rates."""
    nq = len(joints)
    names = [name for name in stream.columns if name != draft.time["column"]]
    blocks = [names[k : k + nq] for k in range(0, len(names) - nq + 1, nq)]
    if len(names) % nq or not 2 <= len(blocks) <= 4:
        return
    t = stream.columns[draft.time["column"]]
    values = [np.stack([stream.columns[name] for name in block], axis=1) for block in blocks]
    every = range(len(blocks))
    pairs = [(k, other) for k, other in permutations(every, 2) if _is_rate(t, values[k], values[other])]
    chain = list({k for k, _ in pairs} - {other for _, other in pairs})
    while len(chain) < 3 and len(following := [other for k, other in pairs if k in chain[-1:]]) == 1:
        chain += following
    torque = set(every) - set(chain)
    if len(chain) < 2 or (chain[0], chain[1]) not in pairs or len(torque) != 1:
        return
    roles = dict(zip(("position", "velocity", "acceleration"), chain, strict=False))
    for quantity, k in {**roles, "torque": torque.pop()}.items():
        columns = dict(zip(joints, blocks[k], strict=True))
        draft.families[quantity] = Family("", columns, stream.name, by_joint=columns)
        where = f"columns {blocks[k][0]} to {blocks[k][-1]}"
        draft.say(quantity, f"{where} have no headings; their values look like a {quantity}", doubt=True)


def _is_rate(t: np.ndarray, x: np.ndarray, v: np.ndarray) -> bool:
    """Return whether v is correlated with the rate of change of x in every column."""
    step = np.diff(t)[:, None]
    rate, mean = np.diff(x, axis=0), 0.5 * (v[1:] + v[:-1]) * step
    good = (step[:, 0] > 0.0) & np.isfinite(rate).all(axis=1) & np.isfinite(mean).all(axis=1)
    rate, mean = rate[good], mean[good]
    if len(rate) < 10 or not (robust_std(rate) > 0.0).all() or not (robust_std(mean) > 0.0).all():
        return False
    return all(np.corrcoef(a, b)[0, 1] > RELATED for a, b in zip(rate.T, mean.T, strict=True))
