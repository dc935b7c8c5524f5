"""Import and its guess end in a data set or in one typed error, whatever the log and the mapping hold."""

from __future__ import annotations

import contextlib
import tempfile
import warnings
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from forcegp import load_robot
from forcegp.constraints import ConstrainedSystem, Plane, SurfaceContact
from forcegp.errors import ForceGPError
from forcegp.logs import import_log, parse_mapping
from forcegp.logs.guess import guess_mapping

ROBOT = load_robot("double_pendulum")
TABLE = SurfaceContact("table", "tip", (0.0, 0.0, 0.0), Plane((0.0, 0.0, 1.0), -2.0))
SYSTEM = ConstrainedSystem(ROBOT, [TABLE])

VALUES = (0.0, -0.0, 1.0, 1e-320, 1e300, -1e300, 1e16, float("nan"), float("inf"))
NUMBERS = st.sampled_from(VALUES) | st.floats(-10.0, 10.0)
POSITIVE = st.sampled_from((1e-320, 1e-12, 1e-6, 1e-3, 0.5, 1e6, 1e300))
NAMES = ("t", "q0", "q1", "v0", "v1", "tau0", "tau1", "touch")


@st.composite
def columns(draw: st.DrawFn) -> dict[str, np.ndarray]:
    """Columns of a log, some constant, some broken, one perhaps of another length."""
    n = draw(st.sampled_from((0, 1, 2, 3, 8, 40, 200)))
    t = np.arange(n) * draw(st.sampled_from((0.0, 1e-300, 1e-3, 0.01, -0.01, 1e200)))
    found: dict[str, np.ndarray] = {"t": t} | {name: np.sin(k + t) for k, name in enumerate(NAMES[1:-1])}
    found["touch"] = (np.arange(n) % 7 < 4).astype(float)
    for name in draw(st.lists(st.sampled_from(NAMES), max_size=4)):
        change = draw(st.sampled_from(("values", "one", "length", "constant", "gone")))
        value = draw(NUMBERS)
        if change == "values":
            found[name] = np.resize(np.array(draw(st.lists(NUMBERS, min_size=1, max_size=9))), n)
        elif change == "one" and n:
            before = np.resize(found.get(name, t), n)
            found[name] = np.where(np.arange(n) == draw(st.integers(0, n - 1)), value, before)
        elif change == "length":
            found[name] = np.full(draw(st.integers(0, 9)), value)
        elif change == "constant":
            found[name] = np.full(n, value)
        else:
            found.pop(name, None)
    return found


@st.composite
def mappings(draw: st.DrawFn) -> str:
    """A mapping of these columns with settings of any size."""
    optional = {key: draw(st.none() | POSITIVE) for key in ("period", "gap")}
    time = "".join(f", {key} = {value!r}" for key, value in optional.items() if value is not None)
    lines = [
        f'time = {{ column = "t"{time}, unit = "{draw(st.sampled_from(("s", "ns", "min")))}" }}',
        f'position = {{ column = "q{{joint}}", unit = "rad", offset = {draw(st.floats(-1e9, 1e9))!r} }}',
        'torque = { column = "tau{joint}", unit = "Nm" }',
        f'joints = {{ {ROBOT.joint_names[0]} = "0", {ROBOT.joint_names[1]} = "1" }}',
    ]
    if draw(st.booleans()):
        lines.append('velocity = { column = "v{joint}", unit = "rad/s" }')
    method = draw(st.sampled_from(("savitzky_golay", "smoother")))
    window, order = draw(st.sampled_from((3, 11, 61, 10001))), draw(st.integers(2, 9))
    lines.append(f'derivatives = {{ method = "{method}", window = {window}, order = {order} }}')
    source = draw(st.sampled_from(("column", "always", "never", "distance", "multiplier")))
    column = ', column = "touch"' if source == "column" else ""
    lines.append(f'contact.table = {{ source = "{source}"{column} }}')
    return "\n".join(lines)


@settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(log=columns(), mapping=mappings(), kind=st.sampled_from(("npz", "csv")))
def test_any_log_is_imported_or_refused(log: dict[str, np.ndarray], mapping: str, kind: str) -> None:
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        path = Path(folder) / f"run.{kind}"
        if kind == "npz":
            np.savez(path, **log)  # pyright: ignore[reportArgumentType]
        else:
            rows = min(map(len, log.values()), default=0)
            table = [",".join(log), *(",".join(f"{x[k]!r}" for x in log.values()) for k in range(rows))]
            path.write_text("\n".join(table))
        with contextlib.suppress(ForceGPError):
            data = import_log(path, SYSTEM, parse_mapping(mapping.encode(), "mapping")).data
            assert all(bool(x.isfinite().all()) for x in (data.t, data.q, data.qd, data.tau, data.qdd))
        with contextlib.suppress(ForceGPError):
            guess_mapping(path, SYSTEM).toml()
