"""Write the valid files that fuzzing starts from; those that are there are left as they are.

PYTHONPATH=src:tests python fuzz/make_corpora.py
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from targets import CORPORA

import forcegp
from forcegp.gp.optimise import LearningOptions
from forcegp.models.minibatch import BatchOptions
from forcegp.models.registry import create
from forcegp.robot.load import BUNDLED
from forcegp.storage.model_file import HEADER, model_path
from logs import random_log
from random_data import random_data, table_system

ROOT = Path(forcegp.__file__).parent


def keep(target: str, name: str, data: bytes) -> None:
    """Write one input unless it is there."""
    path = CORPORA / target / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_bytes(data)


def tables() -> None:
    """Logs of our own."""
    with tempfile.TemporaryDirectory() as folder:
        random_log(12).write(Path(folder) / "log.parquet")
        keep("parquet", "log", (Path(folder) / "log.parquet").read_bytes())
    rows = "\n".join(f"{k / 100},0.{k},0.1,1.5,-2e-1,{k % 2},0" for k in range(9))
    keep("csv", "log", f"t,q.a,qd.a,tau.a,qdd.a,contact.table,segment\n{rows}\n".encode())


def scenes_and_robots() -> None:
    """The bundled ones, and small ones of each kind."""
    for scene in (ROOT / "scene" / "bundled").glob("*.toml"):
        keep("scene", scene.stem, scene.read_bytes())
    keep("scene", "small", b'[robot]\nmodel = "double_pendulum"\n[model]\nnoise = 0.1\n')
    bundled = ROOT / "robot" / "bundled"
    assert BUNDLED
    for path in sorted(bundled.rglob("*.urdf"))[:2]:
        keep("urdf", path.stem, path.read_bytes())
    body = '<body><joint name="a" axis="0 1 0" range="-1 1"/><geom size="0.1" mass="1"/></body>'
    options = '<compiler angle="radian"/><option gravity="0 0 -9.8"/>'
    keep("mjcf", "arm", f"<mujoco>{options}<worldbody>{body}</worldbody></mujoco>".encode())


def models() -> None:
    """A small model of each kind."""
    data = random_data(table_system(), 4)
    for name in ("nn", "gp", "sgp-mean"):
        model = create(name, table_system(), noise=0.1)
        options = BatchOptions(epochs=1) if name == "nn" else LearningOptions(max_evaluations=1)
        fit = model.fit(data, options=options)  # type: ignore[call-arg]
        with tempfile.TemporaryDirectory() as parent:
            file = model_path(Path(parent) / "model")
            fit.save(file)
            with safetensors.safe_open(file, "pt") as opened:
                header = opened.metadata()[HEADER].partition("\n")[2].encode()
            tensors = safetensors.torch.save(safetensors.torch.load_file(file))
        keep("model", name, len(header).to_bytes(4, "little") + header + tensors)


def logs() -> None:
    """Logs of other programs, where their writers are installed."""
    import log_files

    writers: dict[str, Callable] = {
        "log-npz": log_files.write_npz,
        "log-matlab": log_files.write_matlab5,
        "log-hdf5": log_files.write_hdf5,
        "log-rosbag1": log_files.write_rosbag1,
        "log-rosbag2": log_files.write_bare_db3,
        "log-mcap": log_files.write_mcap,
        "log-text": log_files.write_csv,
    }
    for target, write in writers.items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                path, _ = write(Path(folder), log_files.motion(12))
            except ImportError as error:
                print(f"{target}: {error}")
                continue
            keep(target, "log", Path(path).read_bytes())


if __name__ == "__main__":
    torch.manual_seed(0)
    tables()
    scenes_and_robots()
    models()
    logs()
