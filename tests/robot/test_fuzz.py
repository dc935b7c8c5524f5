"""A few hundred mutated robot files: each ends in a robot or in a typed error, in time."""

from __future__ import annotations

import importlib.util
from pathlib import Path

COUNT = 400
SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "fuzz_robot_files.py"


def test_mutated_files_never_crash_or_hang(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("fuzz_robot_files", SCRIPT)
    assert spec is not None and spec.loader is not None
    fuzzer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fuzzer)
    files, path = fuzzer.seeds(), tmp_path / "robot.xml"
    outcomes = []
    for number in range(COUNT):
        path.write_bytes(fuzzer.mutated(files, 20, number))
        outcomes.append(fuzzer.load(path))
    assert [(n, o) for n, o in enumerate(outcomes) if o.startswith("failure")] == []
    # Both sides are reached, or the mutations would test nothing.
    assert {"robot", "RobotFileError", "InertiaError", "UnsupportedRobotError"} <= set(outcomes)
