"""Interpretation of headings: time column, families with one column per joint, units, and sensors.

Columns without headings are identified by their values.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from difflib import SequenceMatcher
from functools import cache
from itertools import permutations
from os.path import commonprefix
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from forcegp.errors import MappingError
from forcegp.logs import units
from forcegp.logs.mapping import Draft, Family
from forcegp.logs.table import LogTable, Stream
from forcegp.robot import RobotModel
from forcegp.robot.free_base import BASE_JOINTS
from forcegp.robust import robust_std

WORDS: dict[str, list[str]] = units.VOCABULARY["words"]
"""Words for each quantity, in the order in which they are tried."""
MEASURED, COMMANDED, MODELLED, AVOIDED = (
    units.VOCABULARY["columns"][kind] for kind in ("measured", "commanded", "modelled", "avoided")
)
"""Words for measured columns, for commands, for outputs of a model, and for other columns to avoid."""
UNMEASURED = {*COMMANDED, *MODELLED, *AVOIDED}
_TIME = re.compile(
    r"^(.*[ _./])?(t|mt|time|times|timestamp|stamp|clock|sec|secs|seconds|ms|millis|zeit|uhrzeit)"
    r"([ _./\[(].*)?$"
)
_DECLARED = re.compile(
    r"(?i)[\[(]([^\])]*)[\])]|^(deg|rad|rpm|nm|mnm|ma)[_ ]"
    r"|[_ ](deg|rad|ms|us|ns|s|nm|mnm|a|ma|rpm|degps|radps|(?:deg|rad)[_/]s2?)$"
    r"|[_ .]((?:deg|rad)[_/]s2?(?=[_ .\[])|(?:degps|radps|deg|rad|rpm|mnm|nm)(?=[_ .\[(\d]))"
)
_NAMED = {word for words in WORDS.values() for word in words}
_KNOWN = _NAMED.union(MEASURED, UNMEASURED)
_DERIVATIVE = re.compile(r"\b(?:d |dd )+(?=q\b)|\bq (?=d*dot\b)")
SPLIT = ("ms", "us", "ns")
"""Units of the second column of a clock with whole seconds."""
LOGGED, DAY = (5e-5, 0.1), 86_400.0
"""Range of the usual step of a log [s], and a day [s]."""
COMMAND_SHARE = 0.6
"""Weight of the columns of a stream that is named like a command."""
_AXES = (("force", "f"), ("torque", "m", "t", "moment"))
ROWS_OF_AXES = 20_000
"""Maximum number of rows from which the axes of a velocity are inferred."""
_SEGMENTS = ("segment", "episode_index", "episode", "trial", "run")


def tokens(name: str) -> list[str]:
    """Return the words of a heading in lower case, treating a derivative of q as one word.

    >>> tokens("actualJointPos_3 [deg]")
    ['actual', 'joint', 'pos', '3', 'deg']
    >>> tokens("d_d_q_3"), tokens("qDot1")
    (['ddq', '3'], ['qdot', '1'])
    >>> tokens("targetQ2"), tokens("dqref")
    (['target', 'q', '2'], ['dq', 'ref'])
    """
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    words = " ".join(re.findall(r"[a-z]+|\d+", spaced.lower()))
    words = _DERIVATIVE.sub(lambda part: part[0].replace(" ", ""), words).split()
    return [part for word in words for part in _parts(word)]


@cache
def _parts(word: str) -> tuple[str, ...]:
    """Return a quantity and its kind written as one word, such as `qdes` or `istwinkel`, as two words."""
    pairs = ((word[:k], word[k:]) for k in range(1, 0 if word in _KNOWN else len(word)))
    for start, end in pairs:
        for quantity, kind in ((start, end), (end, start)):
            if quantity in _NAMED - {"w"} and len(kind) > 2 and kind in UNMEASURED.union(MEASURED):
                return start, end
    return (word,)


def declared_unit(name: str, stream: Stream) -> str | None:
    """Return the unit declared in a heading or in the line below it, or `None`."""
    if name in stream.units:
        return units.spelled(stream.units[name])
    declared = (units.spelled(match[match.lastindex or 0]) for match in _DECLARED.finditer(name))
    return next((unit for unit in declared if unit is not None), None)


def find_time(table: LogTable, draft: Draft) -> Stream:
    """Return the stream that contains the joint columns, and add its time column to the draft."""
    stream = max(table.streams, key=_likeness_to_joints)
    candidates = [*_clocks(stream), *_split_clocks(stream)]
    if not candidates:
        rows = (f"{name} ({len(other)} rows)" for other in table.streams for name in other.columns)
        text = f"{table.source}: no column increases like time, with {len(stream)} rows as the joints"
        got = ", ".join(sorted(rows, key=lambda name: not _TIME.match(name)))[:300] + table.left_out
        hint = "times as numbers, as 2025-11-27 14:03:22.008 or as 27.11.2025 14:03:22,008 are read"
        raise MappingError(text, expected="a column of time stamps with as many rows", got=got, hint=hint)
    _, column, unit, step = max(candidates, key=lambda candidate: candidate[0])
    if unit is not None:
        shown = " and ".join([unit] if isinstance(unit, str) else unit)
        seconds = step * units.TIME[unit] if isinstance(unit, str) else step
        draft.say("time", f"the unit {shown} is declared; steps are {seconds:.6g} s")
    else:
        # Robots are logged at 10 Hz to 20 kHz, so the step alone distinguishes most units.
        scales = ("s", "ms", "us", "ns", "d", "h", "min")
        possible = [u for u in scales if LOGGED[0] <= step * units.TIME[u] <= LOGGED[1]]
        unit = next(iter(possible), "s")
        doubt = unit != "s" or not possible
        draft.say("time", f"steps of {step:.6g} were interpreted as {unit}", doubt)
    for other in (s for s in table.streams if s is not stream and len(s) != len(stream)):
        stamps = [name for name in other.columns if _TIME.match(re.sub(r"\[\d+\]$", "", name.lower()))]
        if stamps and len(stamps) == len(other.columns):
            text = f"{', '.join(stamps)} was left out: {len(other)} rows, where the joints have {len(stream)}"
            draft.say("time", text, doubt=True)
    segment = next((name for name in _SEGMENTS if name in stream.columns), None)
    draft.time = {"column": column, "unit": unit, "segment": segment}
    return stream


def _likeness_to_joints(stream: Stream) -> tuple[bool, float, int]:
    """Return a key by which the stream with the measured joints is the largest."""
    positions = any(_quantity(column) == "position" for column in stream.columns)
    return positions, len(stream.columns) * (COMMAND_SHARE if doubtful(stream.name) else 1.0), len(stream)


Clock = tuple[float, str | list[str], str | list[str] | None, float]
"""Score, columns, declared units and usual step of a candidate for the clock."""


def _evenness(values: np.ndarray) -> tuple[float, float] | None:
    """Return the usual step, and the share of steps close to it, of a column that increases like time."""
    steps = np.diff(values[np.isfinite(values)])
    if not len(steps) or not (steps > 0.0).mean() > 0.95:
        return None
    step = float(np.median(steps[steps > 0.0]))
    return step, float((np.abs(steps - step) < 0.5 * step).mean())


def _clocks(stream: Stream) -> Iterator[Clock]:
    """Yield the columns that increase like time."""
    for name, values in stream.columns.items():
        if (evenness := _evenness(values)) is not None:
            step, even = evenness
            score = 2.0 * (bool(_TIME.match(name.lower())) or name == "header") + even + (name == "header")
            unit = declared_unit(name, stream)
            yield score, name, unit if unit in units.TIME else None, step


def _split_clocks(stream: Stream) -> Iterator[Clock]:
    """Yield pairs of columns that form a clock: seconds and their fraction, or a date and a time of day."""
    for coarse, whole in stream.columns.items():
        if len(whole) < 2 or not np.isfinite(whole).all() or (whole % 1.0).any():
            continue
        date = bool((whole % DAY == 0.0).all() and np.abs(whole).min() >= DAY)
        if not date and not _TIME.match(coarse.lower()) and _unit_of_time(coarse, stream) != "s":
            continue
        for fine in (name for name in stream.columns if name != coarse):
            unit = _unit_of_time(fine, stream)
            unit = unit if unit in SPLIT else "s"
            seconds = stream.columns[fine] * units.TIME[unit]
            named = _TIME.match(fine.lower()) if date else unit in SPLIT and _same_clock(coarse, fine)
            if not named or not ((seconds >= 0.0) & (seconds < (DAY if date else 1.0))).all():
                continue
            if (evenness := _evenness(whole - whole[0] + seconds)) is not None:
                yield 3.5 + evenness[1], [coarse, fine], ["s", unit], evenness[0]


def _unit_of_time(name: str, stream: Stream) -> str | None:
    """Return the unit of time in a heading, or at its end as in `tv_usec`, or `None`."""
    words = tokens(name)
    unit = declared_unit(name, stream) or (units.spelled(words[-1]) if words else None)
    return unit if unit in units.TIME else None


def _same_clock(coarse: str, fine: str) -> bool:
    """Return whether two headings differ only in their last word, such as `stamp.sec` and `stamp.nanosec`."""
    a, b = tokens(coarse), tokens(fine)
    return b[:-1] in (a[:-1], a)


def named_like(name: str, reason: str, quantity: str) -> str:
    """Return the sentence about a name that is not that of a measurement."""
    return f"{name.strip()!r} is named like {reason}, which is not a measured {quantity}"


def doubtful(name: str) -> str | None:
    """Return why a name is not that of a measurement, or `None`."""
    words = tokens(name)
    kinds = (("a command", COMMANDED), ("the output of a model", MODELLED))
    matches = ((kind, word) for kind, listed in kinds for word in words if word in listed)
    return next((f"{kind} ({word!r})" for kind, word in matches), None)


def find_families(stream: Stream, joints: tuple[str, ...], draft: Draft) -> None:
    """Find the columns of each quantity and the log's joint names; leave empty what is not recognised."""
    numbered, alike = _families(stream, joints), _alike(stream, joints)
    for quantity in WORDS:
        rated = _rated(numbered, quantity, stream) or _rated(alike, quantity, stream)
        if rated:
            draft.families[quantity] = best = rated[0]
            if len(rated) > 1:
                listing = ", ".join(family.pattern for family in rated[1:])
                draft.say(quantity, f"{best.pattern!r} was selected; also available: {listing}", doubt=True)
            if _quantity(best.pattern) is None:
                draft.say(quantity, f"the {quantity} was recognised by its unit alone", doubt=True)
            for name in (best.pattern.replace("{joint}", " "), stream.name):
                if (reason := doubtful(name)) is not None:
                    draft.say(quantity, named_like(name, reason, quantity), doubt=True)
    if not draft.families:
        find_by_values(stream, joints, draft)
    _match_joints(joints, draft)
    _partly_measured(stream, joints, draft)
    for quantity, family in draft.families.items():
        if len(valid := _units(family, stream) & set(units.QUANTITY[quantity])) == 1:
            family.unit, family.declared = valid.pop(), True
            draft.say(quantity, f"the unit {family.unit} is declared")
    clock = draft.time["column"]
    used = {*([clock] if isinstance(clock, str) else clock)}
    used.update(*(f.columns.values() for f in draft.families.values()))
    unused = ", ".join(column for column in stream.columns if column not in used) or "(none)"
    for quantity in ("position", "torque"):
        if quantity not in draft.families:
            empty = dict.fromkeys(joints, "")
            draft.families[quantity] = Family("", {}, stream.name, units.SI[quantity], by_joint=empty)
            text = f"no {quantity} was recognised: fill in columns and unit; unused columns: {unused[:300]}"
            draft.say(quantity, text + draft.left_out, doubt=True)


def _partly_measured(stream: Stream, joints: tuple[str, ...], draft: Draft) -> None:
    """Take a torque that is logged for some of the joints; the others are unmeasured."""
    position = draft.families.get("position")
    if "torque" in draft.families or position is None:
        return
    called = draft.joints or dict(zip(joints, joints, strict=True))
    names = {joint: name for joint, name in called.items() if name in position.columns}
    some = [f for f in _families(stream, joints, partly=True) if set(f.columns) < set(names.values())]
    if rated := _rated(some, "torque", stream):
        draft.families["torque"] = best = rated[0]
        best.by_joint = {j: best.columns[name] for j, name in names.items() if name in best.columns}
        best.unmeasured = [joint for joint, name in names.items() if name not in best.columns]
        listing = ", ".join(best.unmeasured)
        draft.say("torque", f"no torque of {listing}: unmeasured, which means an unknown force", doubt=True)


def _families(stream: Stream, joints: tuple[str, ...], partly: bool = False) -> list[Family]:
    """Return groups of columns that differ in a joint name or a number, for all joints or for some."""
    groups: dict[str, dict[str, str]] = {}
    names = "|".join(re.escape(name) for name in sorted(joints, key=len, reverse=True))
    for column in stream.columns:
        joint = re.search(names, column) or re.search(names, column, re.I)
        for match in [*([joint] if joint else []), *re.finditer(r"\d+", column)]:
            pattern = f"{column[: match.start()]}{{joint}}{column[match.end() :]}"
            groups.setdefault(pattern, {})[match[0]] = column
            if match is joint and _quantity(pattern) is not None:
                break
    complete = (
        (p, of) for p, of in groups.items() if len(of) == len(joints) or (partly and len(of) < len(joints))
    )
    return [Family(pattern, of, stream.name) for pattern, of in complete]


def _alike(stream: Stream, joints: tuple[str, ...]) -> list[Family]:
    """Return groups of nq columns with the same unit and the same known words, such as `az_deg`, `el_deg`."""
    if len(joints) == 1:
        return [Family(column, {joints[0]: column}, stream.name) for column in stream.columns]
    groups: dict[object, list[str]] = {}
    for column in stream.columns:
        key = declared_unit(column, stream), *sorted(_KNOWN.intersection(tokens(column)))
        groups.setdefault(key, []).append(column)
    result = []
    for columns in (columns for columns in groups.values() if len(columns) == len(joints)):
        turned = [column[::-1] for column in columns]
        start, end = (re.sub("[A-Za-z0-9]*$", "", commonprefix(x)) for x in (columns, turned))  # noqa: RUF071
        names = {column[len(start) : len(column) - len(end)]: column for column in columns}
        result.append(Family(f"{start}{{joint}}{end[::-1]}", names, stream.name))
    return result


def _units(family: Family, stream: Stream) -> set[str]:
    return {unit for c in family.columns.values() if (unit := declared_unit(c, stream)) is not None}


def _quantity(pattern: str) -> str | None:
    """Return the quantity named in a pattern, or `None`."""
    words = tokens(pattern.replace("{joint}", " "))
    return next((quantity for quantity in WORDS if not set(words).isdisjoint(WORDS[quantity])), None)


def _rated(families: list[Family], quantity: str, stream: Stream) -> list[Family]:
    """Return the families with the name or, in headings without one, the unit of a quantity, best first."""
    scored = []
    for family in families:
        words, named = tokens(family.pattern.replace("{joint}", " ")), _quantity(family.pattern)
        unit = _units(family, stream) - set(units.FORCE)
        if named == quantity or (not named and unit and unit <= set(units.QUANTITY[quantity])):
            score = 1.0 + 0.5 * any(w in MEASURED for w in words) - 0.8 * any(w in UNMEASURED for w in words)
            score -= 0.01 * len(words) + 0.2 * ("current" in words or "currents" in words) + 0.3 * (not named)
            scored.append((score, family))
    return [family for score, family in sorted(scored, key=lambda pair: -pair[0]) if score > 0.0]


def _match_joints(joints: tuple[str, ...], draft: Draft) -> None:
    """Match the robot's joints to the names that the log uses for its positions or, without them, torques."""
    families = sorted(draft.families.items(), key=lambda item: item[0] != "position")
    for quantity, family in families:
        names = list(family.columns)
        if set(names) == set(draft.joints.values() or joints):
            continue
        if all(name.isdigit() for name in names):
            order, how = sorted(names, key=int), "numbered joints were taken from base to tip"
        else:
            likeness = np.array([[_likeness(j, name) for name in names] for j in joints])
            # Among equally similar names, the order in the log decides; the user is asked to check it.
            order = [names[k] for k in linear_sum_assignment(-likeness - 0.3 * np.eye(len(names)))[1]]
            how = "joint names were matched by similarity"
        matched = dict(zip(joints, order, strict=True))
        first = family is families[0][1]
        draft.say("joints" if first else quantity, f"{quantity}: {how}", doubt=True)
        if first:
            draft.joints = matched
        else:
            family.by_joint = {joint: family.columns[name] for joint, name in matched.items()}


def _likeness(joint: str, name: str) -> float:
    a, b = joint.lower(), name.lower()
    numbers = re.findall(r"\d+", a) == re.findall(r"\d+", b)
    return len(set(tokens(a)) & set(tokens(b))) + 0.3 * numbers + SequenceMatcher(None, a, b).ratio()


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


_VECTOR = re.compile(r"(?i)^(.+?)[ ._\[/]*q?([xyzw]|[0-3])\]?$")
_OF_BASE = {"base", "root", "trunk", "torso", "pelvis", "floating", "body", "pose", "twist", "odom"}
_ROLES: tuple[tuple[str, int, set[str], set[str]], ...] = (
    ("quaternion", 4, {"quat", "quaternion", "orientation", "rot"}, set()),
    (
        "accelerometer",
        3,
        {"accelerometer", "acc", "accel", "acceleration"},
        {"accelerometer", "imu", "linear"},
    ),
    ("gyro", 3, {"gyro", "gyroscope"}, set()),
    ("angular_velocity", 3, {"ang", "angular", "omega"}, _OF_BASE),
    ("gyro", 3, {"angular", "ang", "omega"}, {"velocity", "vel", "imu"}),
    ("linear_velocity", 3, {"linear", "lin", "vel", "velocity"}, _OF_BASE),
    ("position", 3, {"pos", "position", "xyz"}, _OF_BASE),
)
"""Keys of `[base]`: number of components, words of which one is needed, and further such words."""


def find_base(table: LogTable, robot: RobotModel, draft: Draft) -> LogTable:
    """Propose `[base]` for the columns of a free base and of an IMU, and return the log without them."""
    pairs = [(stream, _vectors(stream)) for stream in table.streams]
    of_base = next(((s, of) for s, of in pairs if {"position", "quaternion"} <= set(of)), None)
    if BASE_JOINTS[-1] not in robot.joint_names or of_base is None:
        return table
    stream, vectors = of_base
    of_imu = next(((s, of) for s, of in pairs if not {"gyro", "accelerometer"}.isdisjoint(of)), None)
    base: dict[str, object] = {k: [*vectors[k].values()] for k in ("position", "quaternion")}
    base |= {"stream": stream.name or None, "quaternion_order": "xyzw"}
    if "w" not in vectors["quaternion"]:
        base["quaternion_order"] = order = _order(stream, vectors["quaternion"])
        draft.say("base", f"the base is upright for a quaternion in the order {order}", doubt=True)
    if of_imu is not None:
        base |= _imu(*of_imu, robot, draft)
    rates = "linear_velocity", *(() if "gyro" in base else ("angular_velocity",))
    for key in (key for key in rates if key in vectors):
        axes, clear = _axes(stream, vectors, key, str(base["quaternion_order"]))
        base |= {key: [*vectors[key].values()], f"{key.partition('_')[0]}_axes": axes}
        draft.say("base", f"{key} is the derivative of the pose in {axes} axes", doubt=not clear)
    draft.further["base"] = base
    listed = (value for value in base.values() if isinstance(value, list))
    used = {column for columns in listed for column in columns}
    streams = (
        replace(s, columns={name: x for name, x in s.columns.items() if name not in used})
        for s in table.streams
    )
    return replace(table, streams=tuple(streams))


def _vectors(stream: Stream) -> dict[str, dict[str, str]]:
    """Return the columns of each vector of a base or an IMU, by component and in the order x, y, z, w."""
    stems: dict[str, dict[str, str]] = {}
    for column in stream.columns:
        if (match := _VECTOR.match(column)) is not None:
            stems.setdefault(match[1], {})[match[2].lower()] = column
    vectors: dict[str, dict[str, str]] = {}
    for stem, of in stems.items():
        words = {*tokens(stem)}
        for key, count, named, further in _ROLES:
            more = not further or not words.isdisjoint(further)
            if len(of) == count and not words.isdisjoint(named) and more and doubtful(stem) is None:
                vectors.setdefault(key, dict(sorted(of.items(), key=lambda pair: "0123xyzw".index(pair[0]))))
                break
    return vectors


def _rotations(stream: Stream, columns: dict[str, str], order: str) -> Rotation:
    """Return the rotations of a quaternion with columns in the given order."""
    values = np.stack([stream.columns[column] for column in columns.values()], axis=1)
    values = np.roll(values, -1, axis=1) if order == "wxyz" else values
    good = np.isfinite(values).all(axis=1) & (np.linalg.norm(values, axis=1) > 0.0)
    return Rotation.from_quat(np.where(good[:, None], values, [0.0, 0.0, 0.0, 1.0]))


def _order(stream: Stream, columns: dict[str, str]) -> str:
    """Return the order of a quaternion without letters for which the base is more upright."""
    return max(("wxyz", "xyzw"), key=lambda o: _rotations(stream, columns, o).as_matrix()[:, 2, 2].mean())


def _axes(stream: Stream, vectors: dict[str, dict[str, str]], key: str, order: str) -> tuple[str, bool]:
    """Return the axes in which a velocity is correlated with the changes of the pose, and whether clearly."""
    p, v = (
        np.stack([stream.columns[column] for column in vectors[name].values()], axis=1)[:ROWS_OF_AXES]
        for name in ("position", key)
    )
    R = _rotations(stream, vectors["quaternion"], order)[:ROWS_OF_AXES]
    moved = (
        np.diff(p, axis=0) if key == "linear_velocity" else R[:-1].apply((R[:-1].inv() * R[1:]).as_rotvec())
    )
    alike = {"world": v[:-1], "body": R[:-1].apply(v[:-1])}
    good = np.isfinite(moved).all(axis=1) & np.isfinite(v[:-1]).all(axis=1)
    fits = {
        axes: float(np.corrcoef(moved[good].ravel(), x[good].ravel())[0, 1]) if good.any() else 0.0
        for axes, x in alike.items()
    }
    best, other = ("world", "body") if fits["world"] >= fits["body"] else ("body", "world")
    return best, 1.0 - fits[best] < 0.5 * (1.0 - fits[other])


def _imu(
    stream: Stream, vectors: dict[str, dict[str, str]], robot: RobotModel, draft: Draft
) -> dict[str, Any]:
    """Return the keys of an IMU, with its frame by name and its gravity by the mean reading."""
    at = robot.joint_names.index(BASE_JOINTS[-1])
    frames = [
        name for name, parent in zip(robot.frame_names, robot.frame_parents, strict=True) if parent == at
    ]
    frame = next((name for name in frames if "imu" in name.lower()), frames[0])
    imu: dict[str, Any] = {"imu_frame": frame, "imu_stream": stream.name or None}
    imu |= {key: [*vectors[key].values()] for key in ("gyro", "accelerometer") if key in vectors}
    draft.say("base", f"the IMU was taken to have the pose of frame {frame}", doubt=True)
    if "accelerometer" in vectors:
        f = np.stack([stream.columns[column] for column in vectors["accelerometer"].values()], axis=1)
        mean = float(np.linalg.norm(np.nanmean(f, axis=0)))
        imu["gravity"] = mean > 0.5
        imu["acceleration_unit"] = "g" if 0.5 < mean < 2.0 else "m/s2"
        draft.say("base", f"the mean reading of the accelerometer is {mean:.3g}", doubt=True)
    return imu


def find_by_values(stream: Stream, joints: tuple[str, ...], draft: Draft) -> None:
    """Propose families for columns without headings: blocks of one column per joint, and their rates."""
    if not isinstance(draft.time["column"], str):
        return
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
    return all(np.corrcoef(a, b)[0, 1] > 0.95 for a, b in zip(rate.T, mean.T, strict=True))
