"""How faults are planted in raw logs: the format of a fault, the logs, and changes of columns and robots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from real_contact import FORCE, HEIGHT, columns
from scipy.signal import lfilter

import forcegp
from forcegp.constraints import ConstrainedSystem
from forcegp.scene import load_scene
from forcegp.simulate import simulate

HERE = Path(__file__).resolve().parents[1]
REAL = HERE / "../shared/real"
Table = dict[str, NDArray[Any]]
Log = tuple[ConstrainedSystem, Table]
Plant = Callable[[Log], Log]


@dataclass(frozen=True)
class Fault:
    """A fault; kinds and joint (by index) of a finding that names it, or a word of the import's error."""

    log: str
    name: str
    plant: Plant
    kinds: tuple[str, ...]
    joint: int | None = None
    word: str = "?"
    source: str = "distance"
    """Source of the contact labels in the mapping."""


def simulated(scene: str, **settings: Any) -> Log:
    """A bundled scene by MuJoCo's solver, without friction beyond the robot file."""
    loaded = load_scene(scene)
    system = loaded.system()
    solver = replace(loaded.simulation.solver, joint_friction=(), joint_damping=())
    config = replace(loaded.simulation, engine="mujoco", contact="solver", solver=solver, **settings)
    data = simulate(system, config).data
    return system, {"t": data.t.numpy(), "q": data.q.numpy(), "qd": data.qd.numpy(), "tau": data.tau.numpy()}


def wiping() -> Log:
    """The log of the examples; friction of its joints is a true finding."""
    table = np.loadtxt(HERE / "examples/data/ur5_wiping.csv", delimiter=",", skiprows=1)
    of = {name: table[:, 6 * k + 1 : 6 * k + 7] for k, name in enumerate(("q", "qd", "tau"))}
    return load_scene("ur5_wiping").system(), {"t": table[:, 0], **of}


def iiwa() -> Log:
    """A published log of four segments; its torque has the other sign."""
    folder = REAL / "kuka_iiwa14/motion_b"
    t = np.loadtxt(folder / "cur_traj_time_s.txt")
    q, qd, tau = (
        np.loadtxt(folder / f"joint_{name}_measured.txt") for name in ("position", "velocity", "torque")
    )
    robot = forcegp.load_robot(REAL / "kuka_iiwa14/iiwa14.urdf")
    return ConstrainedSystem(robot), {"t": t, "q": q, "qd": qd, "tau": -tau}


def hopper() -> Log:
    """The real leg on its slider."""
    robot = forcegp.load_robot(REAL / "hopper/teststand.urdf")
    signals = ("joint_positions", "joint_velocities", "joint_torques", HEIGHT, FORCE)
    raw = columns(REAL / "hopper/hopping", signals)
    q = np.hstack([raw[HEIGHT], raw["joint_positions"]])
    speed = np.gradient(lfilter(np.ones(31) / 31, 1.0, raw[HEIGHT], axis=0), 1e-3, axis=0)
    qd = np.hstack([speed, raw["joint_velocities"]])
    foot = forcegp.kinematics.frame_pose(robot, torch.from_numpy(q), "contact")[1][:1400, 2]
    ground = forcegp.SurfaceContact(
        name="ground",
        frame="contact",
        point=(0.0, 0.0, 0.0),
        surface=forcegp.Plane(normal=(0.0, 0.0, 1.0), offset=float(foot.median())),
    )
    tau = np.hstack([np.zeros((len(q), 1)), raw["joint_torques"]])
    return ConstrainedSystem(robot, [ground]), {"t": np.arange(len(q)) * 1e-3, "q": q, "qd": qd, "tau": tau}


LOGS: dict[str, Callable[[], Log]] = {
    "kuka_plane": lambda: simulated("kuka_plane", seed=71, duration=16.0, lift_probability=0.2),
    "panda_tilted": lambda: simulated("panda_tilted", seed=72, duration=16.0, lift_probability=0.3),
    "ur5_wiping": wiping,
    "real iiwa": iiwa,
    "hopper": hopper,
}


def change(column: str, of: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Plant:
    """A fault of one column of the log."""
    return lambda log: (log[0], {**log[1], column: of(log[1][column].copy())})


def at(joint: int, of: Callable[[NDArray[np.float64]], Any]) -> Callable[..., NDArray[np.float64]]:
    """A change of the column of one joint."""

    def changed(x: NDArray[np.float64]) -> NDArray[np.float64]:
        x[:, joint] = of(x[:, joint])
        return x

    return changed


def swapped(i: int, j: int, *names: str) -> Plant:
    """Columns of two joints exchanged."""

    def plant(log: Log) -> Log:
        order = list(range(log[0].robot.nq))
        order[i], order[j] = order[j], order[i]
        return log[0], {name: x[:, order] if name in names else x for name, x in log[1].items()}

    return plant


def late(x: NDArray[np.float64], rows: int) -> NDArray[np.float64]:
    """A signal that arrives some rows late."""
    return np.concatenate([np.repeat(x[:1], rows, axis=0), x[:-rows]])


def robot(of: Callable[[forcegp.RobotModel], forcegp.RobotModel]) -> Plant:
    """A robot that is not the one of the log."""
    return lambda log: (log[0].with_robot(of(log[0].robot)), log[1])
