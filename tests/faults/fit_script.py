"""A fit that keeps a checkpoint and is killed at any moment; run as a script by test_random_kills.py."""

from __future__ import annotations

import sys
from pathlib import Path

import forcegp
from forcegp.destination import write_or_keep
from forcegp.storage import checkpoint
from forcegp.storage.folder import check_model_destination
from random_data import random_data, table_system

if __name__ == "__main__":
    checkpoint.INTERVAL = 0.0
    folder, record = Path(sys.argv[1]) / "model", Path(sys.argv[1]) / "fit.ckpt"
    check_model_destination(folder)
    model = forcegp.StructuredGP(table_system(), noise_std=0.1)
    options = forcegp.LearningOptions(max_evaluations=12, warm_start=6)
    print("begin", flush=True)
    model.fit(random_data(table_system(), 20), options=options, checkpoint=record, keep_checkpoint=True)
    write_or_keep(model.save, folder)
    record.unlink()
