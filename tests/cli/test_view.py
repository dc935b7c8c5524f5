"""`forcegp view` of logs that have gaps, as those of `forcegp select`."""

from __future__ import annotations

from pathlib import Path

import torch

from forcegp.cli.view import _stretch
from forces.cases import two_contacts
from logs import random_log


def test_the_motion_ends_at_the_first_gap(tmp_path: Path) -> None:
    system = two_contacts()
    log = random_log(60, joints=system.robot.joint_names)
    kept = torch.ones(60, dtype=torch.bool)
    kept[20:30] = False
    log[kept].write(tmp_path / "rest.parquet")
    shown = _stretch(tmp_path / "rest.parquet", system, 0, 10.0)
    assert torch.equal(shown.t, log.t[:20])
    later = _stretch(tmp_path / "rest.parquet", system, 20, 10.0)
    assert torch.equal(later.t, log.t[30:])
