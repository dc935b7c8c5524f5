"""Speed of the simulator, as a ratio to real time.

    python benchmarks/simulation.py --json result.json

Simulates the bundled scenes and reports simulated time over wall time and over processor time, after a short
run that compiles or loads the kernel. Processor time is the fairer measure on a machine that is shared.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import replace
from pathlib import Path

import torch

from forcegp.scene import load_scene
from forcegp.simulate import simulate

SCENES = ("kuka_plane", "ur5_wiping")
TARGET = 5.0
"""Ratio to real time that the simulation of `kuka_plane` must reach."""
WARM_UP = 0.1


def measure(scene: str, seconds: float) -> dict[str, float | str]:
    """Time of one simulation."""
    read = load_scene(scene)
    system, config = read.system(), read.simulation
    simulate(system, replace(config, duration=WARM_UP))
    wall, processor = time.perf_counter(), time.process_time()
    result = simulate(system, replace(config, duration=seconds))
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    return {
        "scene": scene,
        "engine": result.engine,
        "simulated_s": seconds,
        "wall_s": wall,
        "processor_s": processor,
        "ratio_wall": seconds / wall,
        "ratio_processor": seconds / processor,
        "ms_per_step": 1e3 * processor / len(result.data),
        "acceleration_mismatch_rad_s2": result.acceleration_mismatch,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measure(scene, args.seconds) for scene in args.scenes]
    for row in rows:
        print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    if args.json is not None:
        machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"
        result = {"machine": machine, "target": TARGET, "runs": rows}
        args.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
