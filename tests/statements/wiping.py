"""The bundled log of a wiping UR5, logs of its simulator, and forces read as a user reads them."""

from __future__ import annotations

import dataclasses
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import forcegp
from forcegp.logs import parse_mapping
from forcegp.models.structured_fit import StructuredFit
from forcegp.robot.inertia import from_pseudo_inertia, pseudo_inertia
from forcegp.robot.model import RobotModel
from forcegp.simulate import Sensors, simulate

FOLDER = Path(__file__).resolve().parents[2] / "examples/data"
CSV = FOLDER / "ur5_wiping.csv"
SCENE, TABLE, TOOL = "ur5_wiping", "table", "tool"
DRY = (4.0, 4.0, 3.0, 0.8, 0.8, 0.6)
VISCOUS = (3.0, 3.0, 2.0, 0.4, 0.4, 0.3)
"""Friction of the simulator [N m, N m s/rad], which the robot file lacks. There are no drives."""
SENSORS = Sensors(encoder_resolution=2e-5, velocity_noise=5e-4, torque_noise=0.2)
HELD_OUT = slice(3500, None)
"""The rows of the log that the guide predicts."""


def system() -> forcegp.ConstrainedSystem:
    """The robot and its contact, as the scene describes them."""
    return forcegp.load_scene(SCENE).system()


def imported(path: Path) -> tuple[forcegp.Dataset, Tensor]:
    """A log as the guide imports it, and the readings of the load cell `(n,)` [N]."""
    mapping = parse_mapping((FOLDER / "ur5_wiping.mapping.toml").read_bytes(), "mapping")
    cell = np.genfromtxt(path, delimiter=",", names=True)["table_force"]
    return forcegp.read_log(path, system(), mapping), torch.from_numpy(cell)


@cache
def log() -> tuple[forcegp.Dataset, Tensor]:
    """The bundled log."""
    return imported(CSV)


def with_payload(robot: RobotModel, mass: float) -> RobotModel:
    """The robot with a point mass at the middle of its tool."""
    index = robot.frame_index(TOOL)
    R, p = robot.frame_rotation[index], robot.frame_position[index]
    place = p + R @ torch.tensor([0.0, 0.0, 0.05], dtype=p.dtype)
    J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
    x = torch.cat([place, place.new_ones(1)])
    extra = torch.zeros_like(J)
    extra[-1] = mass * torch.outer(x, x)
    heavy = dict(zip(("mass", "com", "inertia"), from_pseudo_inertia(J + extra), strict=True))
    return robot.replace(**heavy)


@cache
def simulated(payload: float, seed: int, lifts: float = 0.2) -> tuple[forcegp.Dataset, Tensor]:
    """Ten seconds of the scene's simulator with a payload that the robot file lacks, written and imported."""
    scene = forcegp.load_scene(SCENE)
    options = {"duration": 10.0, "sensors": SENSORS, "seed": seed, "lift_probability": lifts}
    config = dataclasses.replace(scene.simulation, **options)
    true = system()
    data = simulate(true.with_robot(with_payload(true.robot, payload)), config).data
    heading = [f"{name}_{i}" for name in ("actual_q", "actual_qd", "actual_torque") for i in range(data.nq)]
    cell = data.multiplier[TABLE] * data.contact[TABLE]
    rows = torch.cat([data.t[:, None], data.q, data.qd, data.tau, cell[:, None]], dim=1).numpy()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        header = ",".join(["timestamp", *heading, "table_force"])
        np.savetxt(path, rows, fmt="%.6f", delimiter=",", header=header, comments="")
        return imported(path)


@dataclasses.dataclass(frozen=True)
class Force:
    """Predicted and true normal force over the closed rows without impacts `(n,)` [N]."""

    mean: Tensor
    std: Tensor
    truth: Tensor

    @property
    def coverage(self) -> float:
        """Fraction of true forces within ±2σ."""
        return float(((self.mean - self.truth).abs() <= 2.0 * self.std).double().mean())

    @property
    def rmse(self) -> float:
        return float((self.mean - self.truth).square().mean().sqrt())


def normal_force(fit: StructuredFit, data: forcegp.Dataset, truth: Tensor) -> Force:
    """Predict the force at the table as the guide does."""
    rows = (data.contact[TABLE] & (data.impact[TABLE] == 0)).nonzero()[:, 0]
    part = data[rows]
    force = fit.predict(part.q, part.qd, part.tau, "multiplier", active=part.active([TABLE]), noise=True)
    assert force.std is not None
    return Force(force.mean[:, 0], force.std[:, 0], truth[rows])


def fitted(data: forcegp.Dataset) -> StructuredFit:
    """A fit with the defaults of the command line."""
    return forcegp.StructuredGP(system(), "analytical").fit(data)
