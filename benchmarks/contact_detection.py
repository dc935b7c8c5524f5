"""Contact and surface found in logs of MuJoCo's contact solver, against what the solver knows.

    python benchmarks/contact_detection.py --json detection.json

Each run is simulated, exported as CSV in degrees and milliseconds, and imported with the contact read from
the distance to the scene's surface, from the wrist sensor, and from the rigid-body multiplier. Printed: the
share of rows whose contact is the solver's, and distance and angle between the surface fitted to the tip's
path and the true one, over that path. The scenes are soft: the tip sinks in by about 0.08 mm.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from pathlib import Path
from typing import Any

from foreign_log import mapping_of, rows_right, surface_error, write_foreign_log

from forcegp.errors import DataError
from forcegp.logs import import_log
from forcegp.scene import load_scene
from forcegp.simulate import simulate

SCENES = ("ur5_wiping", "panda_sphere")
SOURCES = ("distance", "wrench", "multiplier")


def found_in(scene: str, seed: int, duration: float, folder: Path) -> dict[str, Any]:
    """Rows right by source, and the errors of the surface."""
    read = load_scene(scene)
    system = read.system()
    truth = simulate(system, dataclasses.replace(read.simulation, duration=duration, seed=seed)).data
    log = folder / "run.csv"
    write_foreign_log(log, truth, system, seed=seed)
    result: dict[str, Any] = {"scene": scene, "seed": seed}
    for source in SOURCES:
        mapping = folder / "mapping.toml"
        mapping.write_text(mapping_of(system, source))
        try:
            data = import_log(log, system, mapping).data
        except DataError as error:
            # The multiplier of a robot with undeclared friction does not show the contact, and says so.
            result[source] = None
            result[f"{source}_error"] = error.message
            continue
        result[source] = rows_right(data, truth, system)
        if source == SOURCES[0]:
            result |= surface_error(data, system)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description="Contact and surface found in logs of MuJoCo's solver.")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--duration", type=float, default=30.0, help="of each log [s]")
    parser.add_argument("--json", type=Path, default=None, help="file for the result")
    arguments = parser.parse_args()
    results = []
    print(f"{'scene':14} seed " + " ".join(f"{s:>11}" for s in SOURCES) + "  offset [mm]  tilt [deg]")
    for scene in SCENES:
        for seed in range(arguments.seeds):
            with tempfile.TemporaryDirectory() as folder:
                found = found_in(scene, seed, arguments.duration, Path(folder))
            results.append(found)
            shares = (found[s] for s in SOURCES)
            text = " ".join(f"{'refused':>11}" if x is None else f"{100 * x:10.2f}%" for x in shares)
            print(f"{scene:14} {seed:4} {text}  {found['offset_mm']:11.3f}  {found['tilt_degrees']:10.4f}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
