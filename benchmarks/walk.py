"""How many files a reader passes through to follow one call of the library.

    python benchmarks/walk.py --json result.json

A profile records the first call of every function of the package while a scene is read and its system made,
and while a model is fitted, predicts and is rolled out. It counts the files entered and the switches from one
file to another, in the order of these first calls. Bodies of modules and classes are left out, and so are
comprehensions and lambdas, which belong to the function that they stand in.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import torch

import forcegp
from forcegp.data import Dataset, select_points
from forcegp.models.structured_gp import StructuredGP
from forcegp.scene import load_scene
from forcegp.simulate import SimulationConfig, simulate

PACKAGE = str(Path(forcegp.__file__).parent)
LIMITS = {"system": (14, 25), "fit": (20, 45), "predict": (12, 22), "rollout": (20, 35)}
"""Files and switches that each walk may have at most."""
POINTS = 30


def walk(call: Callable[[], Any]) -> list[tuple[str, str]]:
    """File and name of each function of the package, in the order of first calls."""
    seen: set[CodeType] = set()
    order: list[tuple[str, str]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or code in seen or not code.co_filename.startswith(PACKAGE):
            return
        seen.add(code)
        if not code.co_name.startswith("<") and "__module__" not in code.co_names[:2]:
            order.append((str(Path(code.co_filename).relative_to(PACKAGE)), code.co_name))

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return order


def count(order: list[tuple[str, str]]) -> dict[str, Any]:
    """Files entered, switches between files, and the files in order of entry with their numbers of visits."""
    files = [file for file, _ in order]
    visits = [a for a, b in zip(files, [None, *files], strict=False) if a != b]
    return {
        "files": len(set(files)),
        "switches": len(visits) - 1,
        "visits": {file: visits.count(file) for file in dict.fromkeys(files)},
        "functions": [f"{file}:{name}" for file, name in order],
    }


def _log(duration: float) -> Dataset:
    system = load_scene("kuka_plane").system()
    return simulate(system, SimulationConfig(duration=duration, seed=1)).data


def walks() -> dict[str, dict[str, Any]]:
    """The four walks."""
    log = _log(1.0)
    chosen = log[select_points(log, POINTS)]
    model = StructuredGP(load_scene("kuka_plane").system(), mean="analytical", noise=0.1)
    fit = model.fit(chosen, learn=[])
    calls: dict[str, Callable[[], Any]] = {
        "system": lambda: load_scene("kuka_plane").system(),
        "fit": lambda: model.fit(chosen),
        "predict": lambda: fit.predict(log.q, log.qd, log.tau),
        "rollout": lambda: fit.rollout(log.q[0], log.qd[0], log, duration=0.02),
    }
    return {name: count(walk(call)) for name, call in calls.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--list", action="store_true", help="Print the functions, in order of first calls.")
    args = parser.parse_args()
    torch.set_num_threads(1)
    found = walks()
    for name, result in found.items():
        files, switches = LIMITS[name]
        counted = f"{result['files']} files (at most {files}), {result['switches']} switches ({switches})"
        print(f"{name}: {counted}")
        if args.list:
            print("  " + "\n  ".join(result["functions"]))
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
