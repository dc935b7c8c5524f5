"""Run the benchmarks behind the tables of `docs/evidence.md`, and write these tables.

    python benchmarks/evidence.py                       # hours; does not run again what is in the folder
    python benchmarks/evidence.py --again million_rows  # measures one of them again

Each benchmark writes JSON into the folder. Rows of the paper's task, of exported code and of single states
are written by hand, with their commands.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from legs import METHODS
from real_models import LEAST_SQUARES
from real_rollouts import NAME
from results_page import table, write_section
from sticking import pooled

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "evidence.md"
RUNS: dict[str, list[str]] = {
    "real_logs": ["real_logs.py"],
    "real_contact": ["real_contact.py", "--default"],
    "solver_arms": ["solver_arms.py", "--seed", "0", "1", "2"],
    "solver_contacts": ["solver_contacts.py"],
    "external_wrench": ["external_wrench.py"],
    "sticking": ["sticking.py"],
    "geared_arms": ["geared_arms.py"],
    "legs": ["legs.py"],
    "servo": ["servo.py"],
    "currents": ["currents.py"],
    "write_back": ["write_back.py"],
    "write_back_memory": ["write_back.py", "--case", "dahl", "lugre"],
    "log_of_100_s": ["million_rows.py", "--rows", "20000", "--folder", "{folder}/rows"],
    "million_rows": ["million_rows.py", "--folder", "{folder}/rows"],
}
"""Benchmarks and their arguments, by the name of the result."""
APART = ("real_logs", "real_contact", "log_of_100_s", "million_rows")
"""Results on real logs, and durations."""
POSES = {"home": "ordinary", "singular": "near singular"}


def span(values: Iterable[float], digits: int = 2) -> str:
    """The smallest and the largest value."""
    each = list(values)
    low, high = f"{min(each):.{digits}f}", f"{max(each):.{digits}f}"
    return low if low == high else f"{low}–{high}"


def mean(values: Iterable[float]) -> float:
    """The geometric mean."""
    return float(np.exp(np.log(list(values)).mean()))


def real_robots(of: dict[str, Any]) -> str:
    """Errors of torques, accelerations and responses on each real log, relative to least squares."""
    rows = []
    for case, found in of["real_logs"]["cases"].items():
        for test, models in found["tests"].items():
            own = models[NAME]
            ratio = own[f"ratio_to_{LEAST_SQUARES[1]}"]
            joints = ratio["torque_rmse"]
            rows.append(
                [
                    f"{case}: {test}",
                    f"{ratio['torque_rmse_geometric_mean']:.2f} (worst joint {max(joints):.2f})",
                    span(ratio["acceleration_mse"], 3),
                    span(own["torque_response"]),
                    span(own["torque_coverage"]),
                ]
            )
    heads = [
        "log",
        "torque error ÷ least squares",
        "squared acceleration error ÷ least squares, by joint",
        "response to an added torque",
        "±2σ",
    ]
    lines = [table(heads, rows)]
    for case, found in of["real_logs"]["cases"].items():
        if "rollouts" in found:
            paths = found["rollouts"]
            last = paths["horizons_s"][-1]
            own, plain = (paths[key][-1] for key in (NAME, "least squares"))
            share = paths["coverage_of_90_%_bands"]
            errors = f"{own:.3f} rad (least squares {plain:.3f} rad); 90 % bands hold {share:.0%}"
            lines.append(f"Joint angles of the {case} after {last:g} s in open loop: {errors}.")
    return "\n\n".join(lines)


def leg(of: dict[str, Any]) -> str:
    """The force on the foot of the hopping leg."""
    rows = []
    for name, found in of["real_contact"].items():
        if name.startswith("hopping"):
            own, plain = found["forcegp"], found["equations of motion"]
            errors = (", ".join(f"{x:.2f}" for x in each["rmse_N"]) for each in (own, plain))
            rows.append([name, *errors, ", ".join(f"{x:.2f}" for x in own["coverage"])])
    return table(["tested on", "fore-aft, vertical error [N]", "equations of motion [N]", "±2σ"], rows)


def simulated(of: dict[str, Any]) -> str:
    """What simulated arms and legs show."""
    arms = [found["ratios"] for found in of["solver_arms"].values()]
    M = np.abs(np.concatenate([found["mass_matrix"]["fit"] for found in of["solver_arms"].values()]) - 1.0)
    contacts = list(of["solver_contacts"]["results"].values())
    force = span((abs(x["bias_N"]) for x in contacts), 2)
    wrenches = {
        pose: [
            found[part][method]["over identified"]
            for found in of["external_wrench"].values()
            for method in ("acceleration", "momentum")
        ]
        for part, pose in POSES.items()
    }
    rest = {(line[0], line[1]): line[2] for line in pooled(of["sticking"])}
    drives, legs = of["geared_arms"]["summary"], of["legs"]
    written = [found["xml"] for found in of["write_back"].values()]
    memory = {
        kind: [x["memory_over_plain"] for key, x in of["write_back_memory"].items() if f", {kind}," in key]
        for kind in ("dahl", "lugre")
    }
    rows = [
        [
            f"{len(arms)} logs of arms",
            "torque error ÷ least squares",
            f"{span(x['torque'] for x in arms)}, worst joint {max(x['worst_joint'] for x in arms):.2f}; "
            f"±2σ {span(y for x in arms for y in x['coverage'])}",
            "solver_arms",
        ],
        [
            "the same",
            "diagonal of the mass matrix",
            f"median error {100 * np.median(M):.1f} %, largest {100 * M.max():.1f} %",
            "solver_arms",
        ],
        [
            f"{len(contacts)} logs with contact, no sensor",
            "normal force",
            f"bias {force} N at {span((x['force_N'] for x in contacts), 0)} N; "
            f"±2σ {span(x['coverage'] for x in contacts)}",
            "solver_contacts",
        ],
        [
            "a tip that slides, that sticks",
            "force ÷ equations of motion with friction",
            f"{rest['slides', 'forcegp']}, {rest['sticks', 'forcegp']}",
            "sticking",
        ],
        [
            "external wrench",
            "force ÷ momentum observer with identified friction",
            "; ".join(f"{span(x)} in {pose} poses" for pose, x in wrenches.items()),
            "external_wrench",
        ],
        [
            f"{drives['drives']} geared drives",
            "their inertia",
            f"median error {100 * drives['median_error']:.0f} %, ±2σ {drives['within_2']:.2f}",
            "geared_arms",
        ],
        *(
            [
                f"feet, {friction} friction",
                "″" if k else "force ÷ −J⁻ᵀτ; ÷ equations of motion; ÷ the same, identified",
                feet([x for x in legs if x["friction"] == friction]),
                "legs",
            ]
            for k, friction in enumerate(dict.fromkeys(x["friction"] for x in legs))
        ),
        [
            "servos, positions and commands only",
            "joint angles in open loop over 2 s ÷ file",
            span((x["open_loop_rad"] / x["file_rad"] for x in of["servo"]), 3),
            "servo",
        ],
        [
            "motor currents, constants off by 25 %",
            "accelerations ÷ nominal constants",
            span(x["acceleration"] for x in of["currents"]),
            "currents",
        ],
        [
            "written MJCF files",
            "torque error ÷ file; ÷ least squares",
            f"{span(x['over_file'] for x in written)}; {span(x['over_least_squares'] for x in written)}",
            "write_back",
        ],
        [
            "the same with Dahl, LuGre friction",
            "joint angles with ÷ without memory",
            ", ".join(f"{mean(x):.2f} ({span(x)})" for x in memory.values()),
            "write_back --case dahl lugre",
        ],
    ]
    return table(["case", "measure", "result", "benchmark"], rows)


def feet(cases: list[dict[str, Any]]) -> str:
    """Ratios of the errors of the forces of all feet, and coverage of each axis."""
    size = [{key: math.hypot(*x[key]["rmse_N"]) for key in METHODS} for x in cases]
    ratios = "; ".join(span(x["forcegp"] / x[key] for x in size) for key in METHODS[:3])
    return f"{ratios}; ±2σ {span(y for x in cases for y in x['forcegp']['coverage'])}"


def speed(of: dict[str, Any]) -> str:
    """Durations of fits by default."""
    rows = [
        [name, f"{found['seconds']:.1f} s, {found['mebibytes']:.0f} MiB above the import"]
        for name, found in {
            "fit by default to 20,000 rows, 7 joints": of["log_of_100_s"],
            "the same to a million rows in ten Parquet files": of["million_rows"],
        }.items()
    ]
    return table(["operation, 2 threads", "time, memory"], rows)


TABLES = {
    "real robots": (real_robots, ("real_logs",)),
    "leg": (leg, ("real_contact",)),
    "simulated": (simulated, tuple(name for name in RUNS if name not in APART)),
    "fits": (speed, ("log_of_100_s", "million_rows")),
}
"""The tables of the page, and the results that they need."""


def measured(name: str, folder: Path, again: bool) -> Any:
    """The result of a benchmark, which is run if the folder does not contain it."""
    path = folder / f"{name}.json"
    if again or not path.exists():
        script, *arguments = (part.format(folder=folder) for part in RUNS[name])
        command = [sys.executable, str(ROOT / "benchmarks" / script), *arguments, "--json", str(path)]
        print(f"{name}: {' '.join(command[1:])}", flush=True)
        subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    return json.loads(path.read_text(encoding="utf-8"))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--folder", type=Path, default=ROOT / "out" / "evidence", help="folder of the results"
    )
    parser.add_argument("--table", choices=tuple(TABLES), nargs="*", default=list(TABLES))
    parser.add_argument("--again", choices=tuple(RUNS), nargs="*", default=[], help="run these anew")
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    machine = f"{os.cpu_count()} cores, {platform.processor() or platform.machine()}"
    for name in options.table:
        tabulated, needed = TABLES[name]
        results = {key: measured(key, folder, key in options.again) for key in needed}
        day = date.fromtimestamp(min((folder / f"{key}.json").stat().st_mtime for key in needed))
        note = f'{day}, {machine}: `python benchmarks/evidence.py --table "{name}"`'
        write_section(PAGE, name, f"{tabulated(results)}\n\n{note}")


if __name__ == "__main__":
    main()
