"""Predictive control that holds a contact force within bounds while the tool slides, with a learned variance.

    python examples/mpc_holds_a_force.py [figure.png]

A UR5 wipes a circle on a table and is to press with 10 N ± 3 N. MuJoCo's own solver makes the contact, and
the joints have dry friction that the robot file lacks. Each step linearizes acceleration and force along
the last plan. The bounds are a chance constraint, P(|λ − 10 N| ≤ 3 N) ≥ 95 % at each step: the linear
force stays away from them by 1.96 learned standard deviations, so that one convex quadratic program is
left. Where that is more than 3 N, as while a joint hardly moves, no room is left, and the force is held at
10 N as well as possible.
"""

# %% The model: joint and contact friction, learned from eight seconds of wiping with 20 to 35 N
import dataclasses
import sys
import time

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
import torch

import forcegp
from forcegp.forces.priors.sets import friction_priors
from forcegp.kinematics import frame_jacobian, point_position
from forcegp.models.prediction import Predictor
from forcegp.simulate import simulate
from forcegp.simulate.contact_solver import ContactSolverEngine

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "mpc_holds_a_force.png")
PERIOD, HORIZON, SECONDS = 0.01, 8, 5.0
TIP = "tool", (0.0, 0.0, 0.1)  # the point that touches, in its frame [m]
FORCE, BOUND, QUANTILE = 10.0, 3.0, 1.96  # [N], [N], of a normal distribution
scene = forcegp.load_scene("ur5_wiping")
system, n = scene.system(), 6
assert scene.simulation is not None
data = simulate(system, dataclasses.replace(scene.simulation, duration=8.0)).data
fit = forcegp.StructuredGP(system, "analytical", friction_priors(system)).fit(data[::10])
print(fit)

# %% A circle on the table, once in three seconds, with the tool as it stands
moments = np.arange(0.0, SECONDS + HORIZON * PERIOD, PERIOD)
q = data.q[int(data.contact["table"].nonzero()[0])].clone()
begin, rows = point_position(system.robot, q, *TIP), []
for t in moments:
    turn, rate = 2.1 * (t - np.tanh(t)), 2.1 * np.tanh(t) ** 2
    offset = 0.06 * torch.tensor([1.0 - np.cos(turn), np.sin(turn), 0.0], dtype=torch.float64)
    velocity = (
        0.06 * rate * torch.tensor([0.0, 0.0, 0.0, np.sin(turn), np.cos(turn), 0.0], dtype=torch.float64)
    )
    # q̇ = J⁻¹ (ω, ṗ), with the error of the position fed back
    velocity[3:] += (begin + offset - point_position(system.robot, q, *TIP)) / PERIOD
    qd = torch.linalg.solve(frame_jacobian(system.robot, q, *TIP), velocity)
    q = q + PERIOD * qd
    rows.append(torch.cat([q, qd]))
goal = torch.stack(rows).numpy()


# %% The controller: states (q, q̇) and the force λ are linear in the torques of the horizon
class Controller:
    """Implicit Euler steps on the surface, and the torques that hold the force and follow a reference."""

    def __init__(self, predictor: Predictor, start: np.ndarray, torque: np.ndarray) -> None:
        self.predictor, self.std = predictor, np.zeros(HORIZON)
        self.plan = np.tile(np.concatenate([start, torque]), (HORIZON, 1))
        sizes = (HORIZON * (n + 1),) * 2, (HORIZON * 2, HORIZON * (n + 1))
        self.qp = ca.conic("qp", "daqp", dict(zip("ha", (ca.Sparsity.dense(*x) for x in sizes), strict=True)))

    def torque(self, q: np.ndarray, qd: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Torques for the next period; `reference` has (q, q̇) for each step of the horizon."""
        qs, qds, taus = (np.ascontiguousarray(x) for x in np.split(self.plan, 3, axis=1))
        states = torch.from_numpy(qs), torch.from_numpy(qds), torch.from_numpy(taus)
        a, *by, force, force_q, force_qd, force_tau = (x.numpy() for x in self.predictor.linearize(*states))
        std = self.predictor.predict(*states, "multiplier").std
        # A model without error bars aims at 10 N, like the learned one where its bars leave no room.
        self.std = np.full(HORIZON, BOUND / QUANTILE) if std is None else std.numpy()[:, 0]
        x, free = np.concatenate([q, qd]), np.zeros((HORIZON, 2 * n))
        G = np.zeros((HORIZON, 2 * n, HORIZON * n))
        pressed, F = np.zeros(HORIZON), np.zeros((HORIZON, HORIZON * n))
        for k in range(HORIZON):
            # q⁺ = q + h q̇⁺, q̇⁺ = q̇ + h q̈(q⁺, q̇⁺, τ), with q̈ and λ(q⁺, q̇⁺, τ) linearized
            along, rest = np.concatenate([by[0][k], by[1][k]], axis=1), a[k] - by[2][k] @ taus[k]
            rest = rest - along @ self.plan[k, : 2 * n]
            K = np.linalg.inv(np.eye(n) - PERIOD * by[1][k] - PERIOD**2 * by[0][k])
            step = np.concatenate([PERIOD * K, K])
            A = step @ np.block([PERIOD * by[0][k], np.eye(n)])
            A[:n, :n] += np.eye(n)
            B = PERIOD * step
            x = free[k] = A @ x + B @ rest
            G[k] = A @ G[k - 1] if k else 0.0
            G[k, :, k * n : (k + 1) * n] = B @ by[2][k]
            slope = np.concatenate([force_q[k, 0], force_qd[k, 0]])
            pressed[k] = force[k, 0] + slope @ (x - self.plan[k, : 2 * n]) - force_tau[k, 0] @ taus[k]
            F[k] = slope @ G[k]
            F[k, k * n : (k + 1) * n] += force_tau[k, 0]
        weight, flat = np.tile(np.repeat([1e4, 10.0], n), HORIZON), G.reshape(-1, HORIZON * n)
        H = np.zeros((HORIZON * (n + 1),) * 2)
        H[: HORIZON * n, : HORIZON * n] = flat.T * weight @ flat + 1e-4 * np.eye(HORIZON * n)
        H[HORIZON * n :, HORIZON * n :] = 1e4 * np.eye(
            HORIZON
        )  # force beyond the bounds, if there is no other way
        g = np.concatenate([flat.T @ (weight * (free - reference).ravel()), np.zeros(HORIZON)])
        # |λ − 10 N| ≤ 3 N − 1.96 σ + s with the excess s ≥ 0
        room = np.maximum(BOUND - QUANTILE * self.std, 0.0)
        rows = np.block([[F, -np.eye(HORIZON)], [-F, -np.eye(HORIZON)]])
        most = np.concatenate([FORCE + room - pressed, room - FORCE + pressed])
        bound = np.concatenate([np.full(HORIZON * n, 150.0), np.full(HORIZON, np.inf)])
        least = np.concatenate([np.full(HORIZON * n, -150.0), np.zeros(HORIZON)])
        solved = self.qp(h=H, g=g, a=rows, lba=-np.inf, uba=most, lbx=least, ubx=bound)["x"].full()[:, 0]
        u = solved[: HORIZON * n]
        moved = np.concatenate([free + (flat @ u).reshape(HORIZON, 2 * n), u.reshape(HORIZON, n)], axis=1)
        self.plan = np.concatenate([moved[1:], moved[-1:]])
        return u[:n]


# %% The same circle with either model
forces, errors = {}, {}
for name, predictor in {
    "robot file": forcegp.AnalyticalModel(system).nominal(),
    "learned": fit.compiled(),
}.items():
    engine = ContactSolverEngine(system, PERIOD, scene.simulation.solver)
    engine.reset(*torch.from_numpy(goal[0]).split(n))
    hold = -forcegp.dynamics.gravity_force(system.robot, torch.from_numpy(goal[0, :n])).numpy()
    controller, seconds, rows = Controller(predictor, goal[0], hold), [], []
    for i in range(round(SECONDS / PERIOD)):
        q, qd = (x.numpy() for x in engine.state())
        start = time.process_time()
        tau = controller.torque(q, qd, goal[i + 1 : i + 1 + HORIZON])
        seconds.append(time.process_time() - start)
        rows.append([engine.forces(tau).multiplier[0], controller.std[0], np.abs(q - goal[i, :n]).max()])
        engine.step()
    force, std, apart = np.array(rows)[100:].T  # after one second of approach
    forces[name], ms = force, 1e3 * np.median(seconds)
    outside, room = 100 * (np.abs(force - FORCE) > BOUND).mean(), (QUANTILE * std < BOUND).mean()
    print(f"{name}: outside {FORCE:g} ± {BOUND:g} N in {outside:.1f}% of the steps, ", end="")
    print(f"solve {ms:.1f} ms of processor time (median)")
    print(f"  force {force.mean():.2f} ± {force.std():.2f} N, joints off by {1e3 * apart.mean():.1f} mrad")
    if name == "learned":
        print(f"  σ {np.median(std):.2f} N (median), room within the bounds in {room:.0%} of the steps")

# %%
fig, ax = plt.subplots(figsize=(7, 3), layout="constrained")
for name, force in forces.items():
    ax.plot(moments[100 : 100 + len(force)], force, label=name)
ax.axhspan(FORCE - BOUND, FORCE + BOUND, alpha=0.2)
ax.set(xlabel="time [s]", ylabel="contact force [N]", ylim=(0.0, 25.0))
ax.legend()
fig.savefig(figure, dpi=150)
print(f"figure: {figure}")
