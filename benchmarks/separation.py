"""What contact data, two stages, and both kinds of data tell of joint friction and contact friction.

python benchmarks/separation.py --json result.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import forcegp
from forcegp.paper.separation import separate


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--samples", type=int, default=100)
    parser.add_argument("--duration", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    scene = forcegp.load_scene("kuka_plane")
    config = dataclasses.replace(scene.simulation, duration=options.duration, seed=options.seed)
    found = [dataclasses.asdict(way) for way in separate(scene.system(), config, options.samples)]
    print(json.dumps(found, indent=2))
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
