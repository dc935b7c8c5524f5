"""A robot without a force sensor feels its tool: a C program estimates the force at 1 kHz, with error bars.

    python examples/force_observer/force_observer.py [--seconds 60] [--plot] [figure.png]

MuJoCo plays a KUKA iiwa with masses and friction that its file does not have. The arm first moves freely for
40 s, from which the model learns. Then it sends its state through a pipe to `observe.c`, while its tool is
pressed on something, slides along it, carries a payload that appears, and is pushed. The force is compared
with that of generalized-momentum observers, which read the same states: one with the robot file, and one with
a robot and friction that least squares has identified. Their gain is the one with the least error on this
very stream.
"""

# %%
import json
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

import forcegp
from forcegp.errors import optional_module
from forcegp.evaluation.least_squares import identify_rigid
from forcegp.forces.external_wrench import WrenchFrame, momentum_force
from forcegp.forces.posterior import GROWTH
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.logs import parse_mapping
from forcegp.models.external_wrench import velocity_noise
from forcegp.simulate.urdf import write_urdf

mujoco = optional_module("mujoco", "This example")
STEP, TRAINING, EVERY = 0.001, 40.0, 20
HOME = np.array([0.0, 0.6, 0.0, -1.4, 0.0, 1.0, 0.0])
FRAME, TIP = "lbr_iiwa_link_7", (0.0, 0.0, 0.1)
TORQUE_NOISE, VELOCITY_NOISE = 0.1, 1e-3  # [N m], [rad/s]
PRIOR, LASTS = 30.0, 1.5  # size of a force [N], and about how long it lasts [s]
GAINS = (3.0, 5.0, 10.0, 20.0, 40.0, 80.0)  # of the momentum observers [1/s]
PERIOD = 12.0  # of the four contacts [s]
MAPPING = """
time = { column = "t" }
position = { column = "q.{joint}", unit = "rad" }
velocity = { column = "qd.{joint}", unit = "rad/s" }
torque = { column = "tau.{joint}", unit = "Nm" }
derivatives = { window = 61 }
"""


# %% The robot
class Robot:
    """An arm in MuJoCo, under a controller that knows the robot file."""

    def __init__(self, file: forcegp.RobotModel, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.file, self.true = (mujoco.MjModel.from_xml_string(write_urdf(file)) for _ in range(2))
        for model in (self.file, self.true):
            model.opt.timestep, model.opt.gravity[:] = STEP, file.gravity.numpy()
            model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        wrong = 1.0 + 0.05 * self.random.uniform(-1.0, 1.0, self.true.nbody)
        self.true.body_mass[:] *= wrong
        self.true.body_inertia[:] *= wrong[:, None]
        self.true.dof_frictionloss[:] = np.array([4.0, 4.0, 3.0, 3.0, 1.5, 1.0, 0.5])
        self.true.dof_damping[:] = 0.5 * self.true.dof_frictionloss
        self.known, self.data = mujoco.MjData(self.file), mujoco.MjData(self.true)
        self.frequency = 2.0 * np.pi * self.random.uniform(0.08, 0.25, (3, 7))
        self.phase, self.velocity = self.random.uniform(0.0, 2.0 * np.pi, (3, 7)), np.zeros(3)
        self.acceleration = np.zeros(3)  # of the tool, as a payload on a soft hook has it
        self.data.qpos[:], self.data.qvel[:], _ = self.plan(0.0)

    def plan(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joints around the home pose, wanted at a time."""
        w, angle, size = self.frequency, self.frequency * t + self.phase, 0.2
        q = HOME + size * np.sin(angle).sum(0)
        return q, size * (w * np.cos(angle)).sum(0), -size * (w * w * np.sin(angle)).sum(0)

    def step(self, t: float, touched: bool) -> tuple[np.ndarray, np.ndarray]:
        """Move on by a step; the measured q, q̇ and τ before it, and the force on the tool."""
        data = self.data
        q, qd, qdd = self.plan(t)
        known, random = self.known, self.random
        known.qpos[:], known.qvel[:] = data.qpos, data.qvel
        known.qacc[:] = qdd + 100.0 * (q - data.qpos) + 20.0 * (qd - data.qvel)
        mujoco.mj_inverse(self.file, known)
        torque, force = known.qfrc_inverse.copy(), np.zeros(3)
        body = self.true.nbody - 1
        data.qfrc_applied[:] = torque
        if touched:
            place, jacobian = data.xpos[body] + data.xmat[body].reshape(3, 3) @ TIP, np.zeros((3, 7))
            mujoco.mj_jac(self.true, data, jacobian, None, place, body)
            velocity = jacobian @ data.qvel
            self.acceleration += 0.02 * ((velocity - self.velocity) / STEP - self.acceleration)
            force, self.velocity = contact(t, velocity, self.acceleration), velocity
            data.qfrc_applied[:] += jacobian.T @ force
        speed = data.qvel + VELOCITY_NOISE * random.normal(size=7)
        measured = np.concatenate([data.qpos, speed, torque + TORQUE_NOISE * random.normal(size=7)])
        mujoco.mj_step(self.true, data)
        return measured, force


def contact(t: float, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """Force on the tool, as pressing, sliding, a payload and a push follow each other."""
    t = t % PERIOD
    share = np.clip(min(t % 3.0 - 0.7, 2.7 - t % 3.0) / 0.1, 0.0, 1.0)
    if t < 3.0:  # a table presses
        return share * np.array([0.0, 0.0, 25.0])
    if t < 6.0:  # and rubs
        slip = velocity * [1.0, 1.0, 0.0]
        return share * 20.0 * (np.array([0.0, 0.0, 1.0]) - 0.4 * slip / np.sqrt(slip @ slip + 1e-4))
    if t < 9.0:  # 1.5 kg appear
        gravity = np.array([0.0, 0.0, -9.81])
        return 1.5 * (gravity - acceleration) if share > 0.0 else np.zeros(3)
    return 40.0 * np.sin(np.pi * np.clip((t - 10.0) / 0.4, 0.0, 1.0)) * np.array([0.6, 0.8, 0.0])


# %% What the observer needs to know
def learned(file: forcegp.RobotModel, robot: Robot, folder: Path):
    """A fit of free motion, and the robot and friction that least squares identifies from it."""
    times = STEP * np.arange(round(TRAINING / STEP))
    rows = np.array([robot.step(t, False)[0] for t in times])
    header = ",".join(["t", *(f"{x}.{joint}" for x in ("q", "qd", "tau") for joint in file.joint_names)])
    log = np.column_stack([times, rows])
    np.savetxt(folder / "free.csv", log, fmt="%.9g", delimiter=",", header=header, comments="")
    data = forcegp.read_log(folder / "free.csv", file, parse_mapping(MAPPING.encode(), "mapping"))
    planes = [forcegp.Plane(tuple(float(x == axis) for x in range(3)), -10.0) for axis in range(3)]
    tool = [
        forcegp.SurfaceContact(f"tool_{n}", FRAME, TIP, plane) for n, plane in zip("xyz", planes, strict=True)
    ]
    system = forcegp.ConstrainedSystem(file, tool)  # far away, for the Jacobian of the tool alone
    open_ = {each.name: torch.zeros(len(data), dtype=torch.bool) for each in tool}
    priors = [JointFrictionPrior(), InertialPrior()]
    fit = forcegp.StructuredGP(system, "analytical", priors).fit(data.replace(contact=open_)[::EVERY])
    return data, fit, identify_rigid(forcegp.ConstrainedSystem(file), data)


def observer(fit, data: forcegp.Dataset, folder: Path) -> Path:
    """The compiled program."""
    fit.export(folder / "controller")
    lists = {"CORRELATION": fit.problem.correlation, "VELOCITY_NOISE": velocity_noise(data)}
    lists["GROWTH"] = fit.hyperparameters[GROWTH]
    lines = [f"static const double PRIOR = {PRIOR}, LASTS = {LASTS};"]
    for name, x in lists.items():
        lines.append(f"static const double {name}[] = {{{', '.join(map(repr, x.tolist()))}}};")
    (folder / "settings.h").write_text("\n".join(lines) + "\n")
    command = ["cc", "-std=c99", "-O3", "-march=native", "-ffp-contract=fast", f"-I{folder}"]
    command += [f"-I{folder / 'controller'}", str(Path(__file__).with_name("observe.c"))]
    command += [str(folder / "controller/controller.c"), "-o", str(folder / "observe"), "-lm"]
    subprocess.run(command, check=True)
    return folder / "observe"


# %% The loop, at the pace of the clock
READING = struct.Struct("11d")


def stream(program: Path, robot: Robot, seconds: float, show) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, true forces and readings of the observer."""
    pipe, (readings, states, forces) = subprocess.PIPE, ([], [], [])
    with subprocess.Popen([str(program)], bufsize=0, stdin=pipe, stdout=pipe) as process:
        assert process.stdin is not None and process.stdout is not None

        def listen(source) -> None:
            while len(record := source.read(READING.size)) == READING.size:
                readings.append(READING.unpack(record))

        with open(process.stdout.fileno(), "rb", closefd=False) as source:
            listener = threading.Thread(target=listen, args=(source,))
            listener.start()
            begin = time.monotonic()
            for k in range(round(seconds / STEP)):
                t = k * STEP
                state, force = robot.step(t, True)
                time.sleep(max(0.0, begin + t - time.monotonic()))
                process.stdin.write(np.concatenate([[time.monotonic(), t], state]).tobytes())
                states.append(np.concatenate([[t], state]))
                forces.append(force)
                if show is not None and k % 100 == 99:
                    show(np.array(readings[-3000:]), np.array(forces[-3000:]))
            process.stdin.close()
            listener.join()
    return np.array(states), np.array(forces), np.array(readings)


def live():
    """A function that draws the last three seconds."""
    plt.ion()
    _, ax = plt.subplots()

    def show(readings: np.ndarray, forces: np.ndarray) -> None:
        ax.clear()
        n = min(len(readings), len(forces))
        t = readings[-n:, 0]
        for i, name in enumerate("xyz"):
            force, std = readings[-n:, 1 + i], readings[-n:, 4 + i]
            (line,) = ax.plot(t, force, label=f"f{name}, ±2σ")
            ax.fill_between(t, force - 2 * std, force + 2 * std, color=line.get_color(), alpha=0.2)
            ax.plot(t, forces[-n:, i], "k--", lw=0.5, label="" if i else "true")
        ax.set(xlabel="time [s]", ylabel="force [N]")
        ax.legend(loc="upper left", ncols=2)
        plt.pause(0.001)

    return show


# %% Momentum observers on the same states
def momentum_observers(robot: forcegp.RobotModel, losses, states: np.ndarray, truth: np.ndarray) -> float:
    """Least error of ρ̇ = K (ṗ − u − ρ), w = J⁺ᵀ ρ over the gains K, N."""
    t, q, qd, tau = (
        x.squeeze(-1) if x.shape[-1] == 1 else x for x in torch.from_numpy(states).split([1, 7, 7, 7], 1)
    )
    M, added = momentum_force(robot, q, qd)
    u = tau + forcegp.dynamics.gravity_force(robot, q) + forcegp.dynamics.damping_force(robot, qd) + added
    u = u if losses is None else u - losses(qd)
    change = (M @ qd[..., None])[..., 0].diff(dim=0).numpy() / STEP - 0.5 * (u[1:] + u[:-1]).numpy()
    J = WrenchFrame(FRAME, axes=("fx", "fy", "fz"), point=TIP).jacobian(robot, q)
    inverse, errors = torch.linalg.pinv(J.mT).numpy(), []
    for gain in GAINS:
        keep, rho = np.exp(-gain * STEP), np.zeros_like(q.numpy())
        for i in range(1, len(rho)):
            rho[i] = keep * rho[i - 1] + (1.0 - keep) * change[i - 1]
        errors.append(rmse((inverse @ rho[..., None])[..., 0] - truth, t.numpy()))
    return min(errors)


def rmse(error: np.ndarray, t: np.ndarray) -> float:
    """Root mean square of the length of the error after the first half second [N]."""
    return float(np.sqrt((error[t > 0.5] ** 2).sum(-1).mean()))


# %%
def main() -> None:
    arguments = sys.argv[1:]
    figure = next((x for x in arguments if x.endswith(".png")), "force_observer.png")
    seconds = float(arguments[arguments.index("--seconds") + 1]) if "--seconds" in arguments else 60.0
    torch.set_num_threads(1)
    file = forcegp.load_robot("kuka_iiwa")
    with tempfile.TemporaryDirectory() as name:
        robot, folder = Robot(file, seed=1), Path(name)
        data, fit, identified = learned(file, robot, folder)
        program = observer(fit, data, folder)
        robot.phase[:] = robot.random.uniform(0.0, 2.0 * np.pi, (3, 7))
        robot.data.qpos[:], robot.data.qvel[:], _ = robot.plan(0.0)
        states, truth, readings = stream(program, robot, seconds, live() if "--plot" in arguments else None)
    t, force, std = readings[:, 0], readings[:, 1:4], readings[:, 4:7]
    processor, wall, errors = (readings[:, i] for i in (8, 9, 10))
    known = {
        "file": momentum_observers(file, None, states, truth),
        "identified": momentum_observers(identified.system.robot, identified.losses, states, truth),
    }
    result = {
        "samples": len(readings),
        "errors": int((errors != 0.0).sum()),
        "rmse": rmse(force - truth, t),
        **{f"rmse of the observer, {name}": error for name, error in known.items()},
        "coverage": float((np.abs(force - truth) <= 2.0 * std)[t > 0.5].mean()),
        **{f"processor p{p} [us]": 1e6 * float(np.percentile(processor, p)) for p in (50, 99, 99.9)},
        **{f"wall p{p} [us]": 1e6 * float(np.percentile(wall, p)) for p in (50, 99, 99.9)},
    }
    print(json.dumps(result, indent=1))
    _, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 6), layout="constrained")
    for i, ax in enumerate(axes):
        ax.fill_between(t, force[:, i] - 2 * std[:, i], force[:, i] + 2 * std[:, i], alpha=0.3, label="±2σ")
        ax.plot(t, force[:, i], label="observed")
        ax.plot(t, truth[:, i], "k--", lw=1, label="true")
        ax.set(ylabel=f"f{'xyz'[i]} [N]")
    axes[0].legend(ncols=3)
    axes[-1].set(xlabel="time [s]")
    plt.savefig(figure, dpi=150)
    print(f"figure: {figure}")


if __name__ == "__main__":
    main()
