"""Import of a long CSV log: throughput by wall clock and by processor time, and peak memory.

    python benchmarks/import.py --json import.json                  # 3 million rows, 1 GB of text
    python benchmarks/import.py --rows 300000

The log is that of a seven-joint arm with time, positions, velocities, torques and accelerations in degrees
and milliseconds. `forcegp import` runs in a process of its own. On a machine that does other work too,
throughput per second of processor time is the fair number; `--threads 1` pins the child to one core.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

JOINTS = [f"lbr_iiwa_joint_{i}" for i in range(1, 8)]
CHUNK = 50_000
MAPPING = """
[time]
column = "ms"
unit = "ms"
[position]
column = "q.{joint}"
unit = "deg"
[velocity]
column = "v.{joint}"
unit = "deg/s"
[acceleration]
column = "a.{joint}"
unit = "deg/s2"
[torque]
column = "t.{joint}"
unit = "Nm"
"""
ASKED_MB_S, ASKED_GB = 20.0, 2.0


def write_log(path: Path, rows: int) -> None:
    """Smooth motion of seven joints at 1 kHz."""
    random = np.random.default_rng(0)
    rate = random.uniform(0.2, 1.0, 7)
    with path.open("w") as file:
        file.write(",".join(["ms", *(f"{kind}.{name}" for kind in "qvat" for name in JOINTS)]) + "\n")
        for first in range(0, rows, CHUNK):
            ms = np.arange(first, min(first + CHUNK, rows))
            phase = 1e-3 * ms[:, None] * rate
            q, v, a = 40.0 * np.sin(phase), 40.0 * rate * np.cos(phase), -40.0 * rate**2 * np.sin(phase)
            torque = 20.0 * np.sin(phase + 1.0) + random.normal(0.0, 0.1, phase.shape)
            table = np.column_stack([q, v, a, torque])
            lines = (
                f"{t}," + ",".join(f"{x:.7f}" for x in row) for t, row in zip(ms, table.tolist(), strict=True)
            )
            file.write("\n".join(lines) + "\n")


def measured(folder: Path, log: Path, threads: int | None) -> dict[str, float]:
    """Import in a child process: seconds by wall clock and of the processor, and peak memory."""
    mapping, out = folder / "mapping.toml", folder / "log.parquet"
    mapping.write_text(MAPPING)
    command = [sys.executable, "-c", "from forcegp.cli import main; main()", "import", str(log)]
    command += ["--robot", "kuka_iiwa", "--mapping", str(mapping), "--out", str(out)]
    began = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    if threads is not None:
        os.sched_setaffinity(child.pid, sorted(os.sched_getaffinity(0))[:threads])
    _, status, used = os.wait4(child.pid, 0)
    wall = time.perf_counter() - began
    if status != 0:
        raise SystemExit("the import failed")
    megabytes, processor = log.stat().st_size / 1e6, used.ru_utime + used.ru_stime
    return {
        "text_mb": megabytes,
        "wall_s": wall,
        "processor_s": processor,
        "mb_per_wall_s": megabytes / wall,
        "mb_per_processor_s": megabytes / processor,
        "peak_gib": used.ru_maxrss / 2**20,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Import of a long CSV log.")
    parser.add_argument("--rows", type=int, default=3_000_000)
    parser.add_argument("--threads", type=int, default=None, help="cores of the child; default all")
    parser.add_argument("--json", type=Path, default=None, help="file for the result")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "run.csv"
        write_log(log, arguments.rows)
        result = measured(folder, log, arguments.threads)
    result |= {"rows": arguments.rows, "threads": arguments.threads or len(os.sched_getaffinity(0))}
    for key, value in result.items():
        print(f"{key:20} {value:.4g}")
    holds = result["mb_per_wall_s"] >= ASKED_MB_S and result["peak_gib"] <= ASKED_GB
    print(f"asked: {ASKED_MB_S:g} MB/s within {ASKED_GB:g} GiB; {'holds' if holds else 'does not hold'} here")
    if arguments.json is not None:
        machine = f"{platform.processor() or platform.machine()}, Python {platform.python_version()}"
        arguments.json.write_text(json.dumps({"machine": machine, "holds": holds, **result}, indent=2) + "\n")


if __name__ == "__main__":
    main()
