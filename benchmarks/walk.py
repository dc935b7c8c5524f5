"""How many files a reader passes through to follow one call of the library.

    python benchmarks/walk.py --json result.json

A profile records the first call of every function of the package while a model is fitted, predicts and is
rolled out, after everything has been called once before: a measured robot in contact (`ur5_wiping`, two
seconds of MuJoCo's own contact, seed 1, every fourth row, no seed in the header), with the default model.
It counts the files entered and the switches from one file to another, in the order of these first calls.
The equations of motion are one door: what `ConstrainedSystem.equations` calls is not entered. Bodies of
modules and classes are left out, and so are comprehensions and lambdas, which belong to their function.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import torch

import forcegp
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.models.registry import create
from forcegp.scene import load_scene
from forcegp.simulate import simulate

PACKAGE = str(Path(forcegp.__file__).parent)
LIMITS = {"fit": 26, "predict": 12, "rollout": 16}
"""Files that each walk may enter at most."""
SCENE, SECONDS, SEED, EVERY = "ur5_wiping", 2.0, 1, 4
DOOR = ConstrainedSystem.equations.__code__


def walk(call: Callable[[], Any]) -> list[tuple[str, str]]:
    """File and name of each function of the package, in the order of first calls."""
    seen: set[CodeType] = set()
    order: list[tuple[str, str]] = []
    behind = 0

    def note(frame: FrameType, event: str, _: object) -> None:
        nonlocal behind
        code = frame.f_code
        if code is DOOR and event in ("call", "return"):
            behind += 1 if event == "call" else -1
            inside = behind - (event == "call")
        else:
            inside = behind
        if event != "call" or inside or code in seen or not code.co_filename.startswith(PACKAGE):
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


def _log(system: ConstrainedSystem) -> Dataset:
    """A log as a measured robot writes it: the header has no seed."""
    config = dataclasses.replace(load_scene(SCENE).simulation, duration=SECONDS, seed=SEED)
    data = simulate(system, config).data
    extras = {name: x for name, x in data.extras.items() if name != "qdd_clean"}
    return data.replace(extras=extras, header=data.header.model_copy(update={"seed": None}))


def walks() -> dict[str, dict[str, Any]]:
    """The three walks, everything warm."""
    system = load_scene(SCENE).system()
    log, model = _log(system), create("sgp", system)
    train, active = log[::EVERY], log.active(system.contact_names)
    fit = model.fit(train)
    calls: dict[str, Callable[[], Any]] = {
        "fit": lambda: model.fit(train),
        "predict": lambda: fit.predict(log.q, log.qd, log.tau, "multiplier", active=active),
        "rollout": lambda: fit.rollout(log.q[0], log.qd[0], log, duration=0.02, active=active[0]),
    }
    for call in calls.values():
        call()
    return {name: count(walk(call)) for name, call in calls.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--list", action="store_true", help="Print the functions, in order of first calls.")
    args = parser.parse_args()
    torch.set_num_threads(1)
    found = walks()
    for name, result in found.items():
        print(f"{name}: {result['files']} files (at most {LIMITS[name]}), {result['switches']} switches")
        if args.list:
            print("  " + "\n  ".join(result["functions"]))
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
