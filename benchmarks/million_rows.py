"""A fit by default to a million rows of a free seven-joint arm, read from ten Parquet files.

    python benchmarks/million_rows.py --folder /tmp/million --json result.json

The log is a sum of sines with joint friction, ripple, a force on (q, q̇) that no law names, torque noise of
0.3 N m and acceleration noise of 0.05 rad/s². With `--rows 20000`, it is a log of 100 s.
It is written to the folder once. Printed: duration from the files to the fit, passes over the log, and peak
memory above that before the fit. With `--workers 2`, the fit is repeated with a Dask cluster of workers with
one thread each that have started, and durations and results are compared.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import torch

import forcegp
from forcegp.cluster import cluster
from forcegp.data import StreamedDataset
from forcegp.files import write_text
from forcegp.models.structured_fit import StructuredFit

FILES, PERIOD, CHUNK = 10, 0.005, 20_000
TEETH = (30.0, 41.0, 57.0, 66.0, 72.0, 85.0, 99.0)
"""Wave numbers of the ripple of each joint."""


def written(folder: Path, rows: int) -> tuple[Path, ...]:
    """The files of the log, which are written if they are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = forcegp.load_robot("kuka_iiwa")
    generator = torch.Generator().manual_seed(0)
    w, phase = (torch.rand(5, 7, generator=generator, dtype=torch.float64) for _ in range(2))
    w, phase, own = 0.3 + 2.0 * w, 6.28 * phase, rows // FILES
    files = tuple(folder / f"{rows}-{k}.parquet" for k in range(FILES))
    for k, file in enumerate(files):
        if file.exists():
            continue
        t = PERIOD * (torch.arange(own, dtype=torch.float64) + k * own)
        angle = w * t[:, None, None] + phase
        q, qd = 0.5 * angle.sin().sum(1), 0.5 * (w * angle.cos()).sum(1)
        qdd = -0.5 * (w**2 * angle.sin()).sum(1)
        parts = zip(*(x.split(CHUNK) for x in (q, qd, qdd)), strict=True)
        tau = torch.cat([forcegp.dynamics.inverse_dynamics(robot, *part) for part in parts])
        noise = torch.randn(2, own, 7, generator=generator, dtype=torch.float64)
        tau = tau + 0.8 * qd + 1.5 * torch.tanh(qd / 0.03) + 0.5 * torch.sin(q.new_tensor(TEETH) * q)
        tau = tau + 2.0 * torch.sin(q + 0.7 * q.roll(1, -1)) * (1.0 + 0.3 * qd) + 0.3 * noise[0]
        forcegp.Dataset(t, q, qd, tau, qdd + 0.05 * noise[1], robot.joint_names).write(file)
    return files


class CountedLog(StreamedDataset):
    """A log that counts how often it is read."""

    passes = 0

    def pieces(self, share: tuple[int, int] = (0, 1)) -> Iterator[forcegp.Dataset]:
        CountedLog.passes += 1
        return super().pieces(share)


def shared(
    model: forcegp.StructuredGP, files: tuple[Path, ...], fit: StructuredFit, workers: int
) -> dict[str, float]:
    """Duration of the same fit with workers, and the largest relative difference of its parameters."""
    with cluster(workers) as client:
        client.run(import_module, "forcegp.models.structured_fit")
        begin = time.perf_counter()
        other = model.fit(StreamedDataset(files), client=client)
        seconds = time.perf_counter() - begin
    pairs = zip(fit.parameters(), other.parameters(), strict=True)
    return {"seconds": seconds, "difference": max(abs(a.value - b.value) / a.std for a, b in pairs)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="where the log is kept")
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--workers", type=int, help="repeat the fit with this many workers")
    parser.add_argument("--json", type=Path, help="write the results there")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(arguments.threads)
    files = written(arguments.folder, arguments.rows)
    system = forcegp.ConstrainedSystem(forcegp.load_robot("kuka_iiwa"))
    before, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    processed = time.process_time()
    model = forcegp.StructuredGP(system, mean="analytical")
    fit = model.fit(CountedLog(files))
    result = {
        "seconds": time.perf_counter() - begin,
        "process_seconds": time.process_time() - processed,
        "passes": CountedLog.passes,
        "mebibytes": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024,
        "samples": fit.result.samples,
        "worth": fit.result.worth,
    }
    times = f"{result['seconds']:.1f} s ({result['process_seconds']:.1f} s of the processor)"
    print(f"{times}, {result['passes']} passes, {result['mebibytes']:.0f} MiB")
    if arguments.workers:
        result["workers"] = shared(model, files, fit, arguments.workers)
        print(f"{result['workers']['seconds'] / result['seconds']:.2f} × with workers", result["workers"])
    if arguments.json:
        write_text(arguments.json, json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
