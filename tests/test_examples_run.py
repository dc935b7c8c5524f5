"""The example scripts run as they stand, and their results are plausible."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 60.0  # what an example may take


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)


def test_iiwa_friction_halves_the_torque_error_of_the_robot_file() -> None:
    done = run("examples/real_iiwa_friction.py")
    assert done.returncode == 0, done.stderr
    rows = re.findall(r"iiwa_joint_\d +([\d.]+) +([\d.]+) +(\d+)%", done.stdout)
    assert len(rows) == 7
    before, after, covered = zip(*(map(float, row) for row in rows), strict=True)
    assert all(new < old for new, old in zip(after, before, strict=True))
    summary = re.search(r"robot file: ([\d.]+) \(geometric mean\)", done.stdout)
    assert summary is not None and float(summary[1]) < 0.5
    # The range that is asked of coverage on held-out segments of this log.
    assert all(88.0 <= share <= 98.0 for share in covered)


def test_missing_logs_are_named() -> None:
    done = run("benchmarks/real_logs.py", "--logs", "/nowhere")
    assert done.returncode == 1
    assert "/nowhere/kuka_iiwa14: this log is not here" in done.stderr
    assert "--logs" in done.stderr
    assert "Traceback" not in done.stderr
