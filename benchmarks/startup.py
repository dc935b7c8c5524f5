"""How long a user waits at the start: import, help of the command, load of a model, and a first fit.

    python benchmarks/startup.py --json result.json

The programs run in turn in fresh processes, after one round that fills the caches of files and of bytecode
(pip compiles what it installs). Wall and processor times are medians. The bounds hold for the wall time on a
machine without other load; the load of a model is compared with `import torch` of the same round.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

import forcegp
from forcegp.simulate import SimulationConfig, simulate

PROGRAMS = {
    "import forcegp": "import forcegp",
    "forcegp --help": "import sys; sys.argv = ['forcegp', '--help']; from forcegp.cli import main; main()",
    "import torch": "import torch",
    "load_model": "import sys, forcegp; forcegp.load_model(sys.argv[1])",
    "forcegp fit": "import sys, pathlib; from forcegp.__main__ import main; "
    "at = pathlib.Path(sys.argv[1]).parent; "
    "sys.argv = f'forcegp fit -s ur5_wiping -d {at}/train.parquet -o {at}/fitted'.split(); main()",
}
LOG = Path(__file__).parents[1] / "examples/data/ur5_wiping.csv"
SECONDS = {"import forcegp": 0.3, "forcegp --help": 0.5}
PROCESSOR_SECONDS = {"forcegp fit": 6.0}
LOAD_TO_TORCH = 1.5


def waited(code: str, model: Path) -> tuple[float, float]:
    """Wall and processor seconds of one fresh process, which finds its bytecode."""
    environment = os.environ | {"PYTHONPYCACHEPREFIX": str(model.parent / "bytecode")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-c", code, str(model)]
    before, start = os.times(), time.perf_counter()
    done = subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=False)
    wall, after = time.perf_counter() - start, os.times()
    if done.returncode != 0:
        raise RuntimeError(f"{code!r} ended with {done.returncode}")
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return wall, cpu


def save_model(folder: Path) -> Path:
    """A structured model with 100 samples."""
    system = forcegp.load_scene("kuka_plane").system()
    data = simulate(system, SimulationConfig(duration=2.0, seed=1)).data
    model = forcegp.StructuredGP(system, mean="analytical", noise=0.1)
    model.fit(data[:400:4], learn=[]).save(folder / "model")
    return folder / "model"


def save_log(folder: Path) -> None:
    """The 1200 rows of `docs/howto/log_to_model.md`."""
    mapping, whole = LOG.with_suffix(".mapping.toml"), folder / "log.parquet"
    steps = (
        f"import {LOG} --scene ur5_wiping --mapping {mapping} --out {whole}",
        f"select {whole} -n 1200 --split stretches --stretch 2 --method even --out {folder}/train.parquet",
    )
    for step in steps:
        subprocess.run([sys.executable, "-m", "forcegp", *step.split()], check=True, capture_output=True)


def measure(repeats: int) -> dict[str, dict[str, float]]:
    """Medians of wall and processor time for each program, and of the ratio to `import torch`."""
    runs: dict[str, list[tuple[float, float]]] = {name: [] for name in PROGRAMS}
    with tempfile.TemporaryDirectory() as folder:
        model = save_model(Path(folder))
        save_log(Path(folder))
        for _ in range(repeats + 1):
            for name, code in PROGRAMS.items():
                runs[name].append(waited(code, model))
    found = {}
    for name, times in runs.items():
        pairs = list(zip(times, runs["import torch"], strict=True))[1:]
        found[name] = {
            "wall": statistics.median(one[0] for one, _ in pairs),
            "cpu": statistics.median(one[1] for one, _ in pairs),
            "wall_to_torch": statistics.median(one[0] / torch[0] for one, torch in pairs),
            "cpu_to_torch": statistics.median(one[1] / torch[1] for one, torch in pairs),
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    torch.set_num_threads(1)
    found = measure(args.repeats)
    for name, result in found.items():
        bound = f" (at most {SECONDS[name]} s)" if name in SECONDS else ""
        if name in PROCESSOR_SECONDS:
            bound = f" (processor at most {PROCESSOR_SECONDS[name]} s)"
        print(f"{name}: {result['wall']:.2f} s, processor {result['cpu']:.2f} s{bound}")
    load = found["load_model"]
    print(f"load_model / import torch: {load['wall_to_torch']:.2f} (at most {LOAD_TO_TORCH})")
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
