"""Model predictive control of an arm whose friction and payload the robot file lacks, in MuJoCo.

    python examples/mpc_with_learned_friction.py [figure.png]

A KUKA iiwa carries a hidden payload, and its joints have dry and viscous friction. A controller that
predicts by the robot file follows a fast motion badly; the same controller on the learned model follows it
closely. Each step linearizes the model along the last plan (the learned one by its C code) and solves one
quadratic program.
"""

# %% The arm as it is, and the arm of the file
import sys
import time

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
import torch

import forcegp
from forcegp import dynamics
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.models.prediction import Predictor
from forcegp.simulate.engines import make_engine

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "mpc_with_learned_friction.png")
robot = forcegp.load_robot("kuka_iiwa")
drives = torch.tensor([0.4, 0.4, 0.3, 0.3, 0.1, 0.05, 0.05], dtype=torch.float64)
robot = robot.replace(armature=drives)  # inertia of the drives [kg m²]
n, PERIOD, STEP, HORIZON = robot.nq, 0.02, 0.001, 12
LIMIT = np.array([320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0])
PAYLOAD, ARM = 3.0, 0.12  # kg, m from the flange along its axis


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


mass, com, inertia = robot.mass.clone(), robot.com.clone(), robot.inertia.clone()
offset, eye = vector(0.0, 0.0, ARM) - com[-1], torch.eye(3, dtype=torch.float64)
mass[-1] += PAYLOAD
com[-1] += offset * PAYLOAD / mass[-1]
apart = PAYLOAD * robot.mass[-1] / mass[-1] * (offset @ offset * eye - torch.outer(offset, offset))
inertia[-1] += 0.01 * eye + apart  # a ball of 3 kg, and both masses apart from their common centre
actual = robot.replace(
    mass=mass,
    com=com,
    inertia=inertia,
    damping=vector(3.0, 3.0, 2.0, 2.0, 1.0, 0.5, 0.1),
    friction=vector(6.0, 6.0, 4.0, 4.0, 2.0, 1.0, 0.4),
    friction_velocity=vector(*[0.1] * 7),
)
engine = make_engine(actual, STEP, "mujoco")


def sines(t: np.ndarray, size: float, rate: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles and velocities of a smooth motion, a row for each time."""
    phase = np.random.default_rng(seed).uniform(0.0, 6.28, (2, n))
    middle, speeds = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0]), rate * np.linspace(0.8, 1.25, n)
    turn = np.multiply.outer(t, speeds)
    q = middle + size * (np.sin(turn + phase[0]) + 0.4 * np.sin(2.3 * turn + phase[1]))
    return q, size * speeds * (np.cos(turn + phase[0]) + 0.92 * np.cos(2.3 * turn + phase[1]))


def step(tau: torch.Tensor) -> None:
    """One step of the arm with given motor torques."""
    engine.step(tau + dynamics.damping_force(actual, engine.state()[1]))


# %% Twelve seconds of slow motion are the log; a Gaussian process learns what the file lacks
t = np.arange(0.0, 12.0, STEP)
motion = torch.from_numpy(np.concatenate(sines(t, 0.35, 2.0, seed=1), axis=1))
engine.reset(*motion[0].split(n))
gains, rows = vector(400.0, 400.0, 250.0, 250.0, 60.0, 30.0, 10.0), []
for at, rate in (x.split(n) for x in motion):
    q, qd = engine.state()
    tau = gains * (at - q) + 0.15 * gains * (rate - qd) - dynamics.gravity_force(robot, q)
    rows.append(torch.cat([q, qd, tau]))
    step(tau)
q, qd, tau = torch.stack(rows)[::20].split(n, dim=1)
qdd = dynamics.forward_dynamics(actual, q, qd, tau + dynamics.damping_force(actual, qd))
qdd = qdd + 0.1 * torch.randn(qdd.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
log = forcegp.Dataset(
    t=torch.from_numpy(t[::20]), q=q, qd=qd, tau=tau, qdd=qdd, joint_names=robot.joint_names
)
system = forcegp.ConstrainedSystem(robot)
model = forcegp.StructuredGP(system, "analytical", [JointFrictionPrior(), InertialPrior()], noise=0.1)
fit = model.fit(log[::3])
print(fit)


# %% The controller: linearize along the last plan, condense, and solve one quadratic program
class Controller:
    """Implicit Euler steps of the model over a horizon, and the torques that follow a reference best."""

    def __init__(self, predictor: Predictor, q: np.ndarray) -> None:
        self.predictor, self.plan = predictor, np.tile(np.concatenate([q, np.zeros(2 * n)]), (HORIZON, 1))
        dense = ca.Sparsity.dense(HORIZON * n, HORIZON * n)
        self.qp = ca.conic("qp", "daqp", {"h": dense})
        self.weight = np.tile(np.repeat([1e4, 10.0], n), HORIZON)

    def torque(self, q: np.ndarray, qd: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Torques for the next period; `reference` has (q, q̇) for each step of the horizon."""
        qs, qds, taus = (np.ascontiguousarray(x) for x in np.split(self.plan, 3, axis=1))
        along = self.predictor.linearize(*map(torch.from_numpy, (qs, qds, taus)))
        a, by_q, by_qd, by_tau = (x.numpy() for x in along[:4])
        eye, G, x = np.eye(n), np.zeros((HORIZON, 2 * n, HORIZON * n)), np.concatenate([q, qd])
        free = np.zeros((HORIZON, 2 * n))
        for k in range(HORIZON):
            # q⁺ = q + h q̇⁺, q̇⁺ = q̇ + h q̈(q⁺, q̇⁺, τ), with q̈ linearized
            K = np.linalg.inv(eye - PERIOD * by_qd[k] - PERIOD**2 * by_q[k])
            rest = a[k] - by_q[k] @ qs[k] - by_qd[k] @ qds[k] - by_tau[k] @ taus[k]
            A = np.block([[eye + PERIOD**2 * K @ by_q[k], PERIOD * K], [PERIOD * K @ by_q[k], K]])
            B = PERIOD * np.concatenate([PERIOD * K, K])
            x = free[k] = A @ x + B @ rest
            G[k] = A @ G[k - 1] if k else 0.0
            G[k, :, k * n : (k + 1) * n] = B @ by_tau[k]
        G = G.reshape(-1, HORIZON * n)
        H = G.T * self.weight @ G + 1e-4 * np.eye(HORIZON * n)
        g = G.T @ (self.weight * (free - reference).ravel())
        bound = np.tile(LIMIT, HORIZON)
        u = self.qp(h=H, g=g, lbx=-bound, ubx=bound, x0=taus.ravel())["x"].full()[:, 0]
        states = free + (G @ u).reshape(HORIZON, 2 * n)
        moved = np.concatenate([states, u.reshape(HORIZON, n)], axis=1)
        self.plan = np.concatenate([moved[1:], moved[-1:]])
        return u[:n]


# %% A motion twice as fast as the log, with either model
moments = np.arange(0.0, 4.0, PERIOD)
goal = np.concatenate(sines(np.arange(0.0, 5.0, PERIOD), 0.35, 4.0, seed=2), axis=1)
errors, models = {}, {"robot file": forcegp.AnalyticalModel(system).nominal(), "learned": fit.compiled()}
for name, predictor in models.items():
    controller, seconds = Controller(predictor, goal[0, :n]), []
    engine.reset(*torch.from_numpy(goal[0]).split(n))
    errors[name] = np.zeros((len(moments), n))
    for i in range(len(moments)):
        q, qd = (x.numpy() for x in engine.state())
        start = time.process_time()
        tau = controller.torque(q, qd, goal[i + 1 : i + 1 + HORIZON])
        seconds.append(time.process_time() - start)
        errors[name][i] = q - goal[i, :n]
        for _ in range(round(PERIOD / STEP)):
            step(torch.from_numpy(tau))
    rms = 1e3 * np.sqrt((errors[name] ** 2).mean())
    ms = 1e3 * np.median(seconds)
    print(f"{name}: tracking error {rms:.2f} mrad, solve {ms:.1f} ms of processor time (median)")

# %%
fig, axes = plt.subplots(2, 1, figsize=(7, 4), layout="constrained", sharex=True, sharey=True)
for ax, (name, error) in zip(axes, errors.items(), strict=True):
    ax.plot(moments, 1e3 * error)
    ax.set(title=name, ylabel="error [mrad]")
axes[1].set(xlabel="time [s]")
fig.savefig(figure, dpi=150)
print(f"figure: {figure}")
