"""Contact forces where the tip sticks and where it slides, beside equations of motion; MuJoCo is the truth.

    python benchmarks/sticking.py --json result.json      # some minutes
    python benchmarks/sticking.py --scene ur5_wiping --friction dahl --seeds 1

Two logs of one robot, whose file lacks the friction of its joints: in one the tip slides with the scene's
friction, in the other friction is so high that the tip sticks while the controller pulls at it; in both it
lifts off now and then. The first halves of both are learned from together, the second halves are tested, all
three components of the force on the tip. Joints at rest creep in MuJoCo's friction (`soft`), or hold like
springs in Dahl's (`dahl`). The contact is declared, and nothing is said about its sticking. Rows count as
sticking below the speed that divides those of the log.

- `equations of motion`: least squares of M q̈ − Q_K − τ = J_EᵀF with the file.
- `with friction`: the same, with viscous and dry friction and an offset of each joint from the free motion of
  training; `and gain`: with a gain and load friction too.
- `forcegp`: the force along the log, given the accelerations (`contact_force`).
- `forcegp wrench`: the external wrench at the tip, no contact declared.
- `forcegp predict`: the force predicted from q, q̇ and τ.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from classical_wrench import TERMS, identified_losses
from results_page import table
from solver_contacts import KUKA, MOTION
from torch import Tensor

import forcegp
from forcegp.constraints.gauss import tangent_frame
from forcegp.errors import optional_module
from forcegp.logs.from_contact import resting_speed
from forcegp.models.structured_fit import StructuredFit
from forcegp.scene import load_scene
from forcegp.simulate import simulate

SCENES = ("ur5_wiping", "kuka_plane", "panda_sphere")
FRICTIONS = ("soft", "dahl")
DISTANCE = 0.02
"""Over which Dahl's friction develops [rad]."""
DURATION, AREA = 40.0, (0.03, 0.03)
"""Of each log [s], and where the tip that sticks is pulled to [m]."""
HIGH_FRICTION = 3.0
EVERY, TESTED = 4, 3
"""Every so many rows are learned from, and tested."""
FRICTION = ("offset", "viscous", "Coulomb")
"""Terms of the plain regression."""


class Dahl:
    """Dry friction with memory in place of MuJoCo's, dz/dt = q̇/δ − |q̇| z/δ, as its callback."""

    def __init__(self, robot: forcegp.RobotModel) -> None:
        self.joint_names = robot.joint_names

    @contextmanager
    def installed(self, model: Any) -> Iterator[None]:
        """Install the callback, and take the dry friction out of the model."""
        mujoco = optional_module("mujoco", "This benchmark")
        self.dof = np.array([model.joint(name).dofadr[0] for name in self.joint_names])
        self.dry, self.bristle, self.time = model.dof_frictionloss[self.dof], np.zeros(len(self.dof)), 0.0
        model.dof_frictionloss[self.dof] = 0.0
        mujoco.set_mjcb_passive(self)
        try:
            yield
        finally:
            mujoco.set_mjcb_passive(None)

    def __call__(self, model: Any, data: Any) -> None:
        """Add the force; the bristles move on with the time of the engine."""
        speed = data.qvel[self.dof]
        end = np.sign(speed)
        self.bristle = end + (self.bristle - end) * np.exp(
            -np.abs(speed) * (data.time - self.time) / DISTANCE
        )
        self.time = data.time
        data.qfrc_passive[self.dof] -= self.dry * self.bristle


def truth(data: forcegp.Dataset, contact: str) -> Tensor:
    """The force on the tip `(n, 3)` [N]."""
    return data.contact_extras["F_I"][contact] + data.contact_extras["F_z"][contact]


def residual(system: forcegp.ConstrainedSystem, data: forcegp.Dataset) -> tuple[Tensor, Tensor, Tensor]:
    """M q̈ − Q_K − τ `(n, nq)`, J_E `(n, 3, nq)` and the speed of the tip along the surface `(n,)`."""
    eom = system.equations(data.q, data.qd)
    point = eom.contact_points[system.contacts[0].name]
    left = (eom.M @ data.qdd[..., None])[..., 0] - eom.Q_K - data.tau
    return left, point.jacobian, point.sliding[1].norm(dim=-1)


def plain(
    system: forcegp.ConstrainedSystem, train: forcegp.Dataset, test: forcegp.Dataset
) -> dict[str, Tensor]:
    """The force by equations of motion, without friction and with that of free motion, `(n, 3)`."""
    name = system.contacts[0].name
    free = train[~train.contact[name]]
    left, _, _ = residual(system, free)
    rest, J, _ = residual(system, test)
    forces = {"equations of motion": rest}
    for name, terms in {"with friction": FRICTION, "and gain": tuple(TERMS)}.items():
        losses = identified_losses(left, free.qd, free.tau, terms)
        forces[name] = rest - losses(test.qd, test.tau)
    return {k: torch.linalg.lstsq(J.mT, r[..., None]).solution[..., 0] for k, r in forces.items()}


def score(error: Tensor, std: Tensor | None = None) -> dict[str, float]:
    result = {"rmse_N": float(error.square().sum(-1).mean().sqrt())}
    if std is not None:
        result["median_std_N"] = float(std.square().sum(-1).sqrt().median())
        result["coverage"] = float((error.abs() <= 2.0 * std).double().mean())
    return result


def predicted(fit: StructuredFit, data: forcegp.Dataset) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the force without accelerations `(n, 3)`, F_I + F_z of one contact."""
    (contact,) = fit.system.contacts
    both = fit.predict(
        data.q,
        data.qd,
        data.tau,
        ("contact_force", "contact_friction"),
        active=data.active((contact.name,)),
        noise=True,
    )
    point = fit.system.equations(data.q, data.qd).contact_points[contact.name]
    t = tangent_frame(point.unit_normal)
    friction = t @ torch.linalg.pinv((t.mT @ point.jacobian).mT)
    P = torch.cat([torch.eye(3).to(t).expand(len(t), 3, 3), friction], dim=-1)
    assert both.covariance is not None
    variance = (P @ both.covariance @ P.mT).diagonal(dim1=-2, dim2=-1)
    return (P @ both.mean[..., None])[..., 0], variance.clamp(min=0.0).sqrt()


def recorded(
    scene: str, friction: str, seed: int, seconds: float
) -> tuple[forcegp.ConstrainedSystem, dict[str, forcegp.Dataset]]:
    """The system, and the logs in which the tip slides and sticks."""
    loaded = load_scene(scene)
    system, config = loaded.system(), loaded.simulation
    if scene == "kuka_plane":
        solver = dataclasses.replace(config.solver, **KUKA)
        config = dataclasses.replace(MOTION, center=config.center, size=config.size, solver=solver)
    slides = dataclasses.replace(config, seed=seed, duration=seconds)
    solver = dataclasses.replace(slides.solver, friction=HIGH_FRICTION)
    sticks = dataclasses.replace(slides, seed=seed + 100, size=AREA, solver=solver)
    logs = {}
    for name, each in {"slides": slides, "sticks": sticks}.items():
        forces: Any = Dahl(system.robot) if friction == "dahl" else None
        logs[name] = simulate(system, each, forces=forces).data
    return system, logs


def scores(scene: str, friction: str, seed: int, seconds: float) -> dict[str, dict[str, dict[str, float]]]:
    """Scores of each method, where the tip sticks and where it slides."""
    system, logs = recorded(scene, friction, seed, seconds)
    (contact,) = system.contacts
    assert isinstance(contact, forcegp.SurfaceContact)
    half = {name: len(log) // 2 for name, log in logs.items()}
    train = forcegp.Dataset.concatenate([log[: half[name]] for name, log in logs.items()])
    stick_speed = resting_speed(residual(system, train[train.contact[contact.name]])[2].numpy())
    assert stick_speed is not None
    fit = forcegp.StructuredGP(system, "analytical").fit(train[::EVERY])
    result = {}
    for name, log in logs.items():
        test = log[half[name] :: TESTED]
        _, _, speed = residual(system, test)
        moves = speed < stick_speed if name == "sticks" else speed > stick_speed
        rows, true = test.contact[contact.name] & moves, truth(test, contact.name)
        own = {k: score((force - true)[rows]) for k, force in plain(system, train, test).items()}
        open_ = test.replace(contact={contact.name: torch.zeros_like(rows)})
        wrench = fit.external_wrench(
            open_, contact.frame, axes=("fx", "fy", "fz"), point=tuple(contact.point)
        )
        force = fit.contact_force(test)
        forces = {"": (force.mean, force.std), " wrench": (wrench.mean, wrench.std)}
        for label, (mean, std) in {**forces, " predict": predicted(fit, test)}.items():
            assert std is not None
            own[f"forcegp{label}"] = score((mean - true)[rows], std[rows])
        result[name] = own
    return result


def pooled(result: dict[str, list[dict[str, dict[str, dict[str, float]]]]]) -> list[list[str]]:
    """Scores over all cases: RMSE over that of equations of motion with friction, and median σ over RMSE."""
    lines, runs = [], [run for seeds in result.values() for run in seeds]
    for state in ("slides", "sticks"):
        for method in ("forcegp", "forcegp wrench", "forcegp predict"):
            own, plain = [r[state][method] for r in runs], [r[state]["with friction"] for r in runs]
            total, before = (math.sqrt(sum(x["rmse_N"] ** 2 for x in xs) / len(xs)) for xs in (own, plain))
            worst = max(x["rmse_N"] / y["rmse_N"] for x, y in zip(own, plain, strict=True))
            std, covered = (sum(x[key] for x in own) / len(own) for key in ("median_std_N", "coverage"))
            figures = (total / before, worst, std / total, covered)
            lines.append([state, method, *(f"{x:.2f}" for x in figures)])
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", choices=SCENES, action="append")
    parser.add_argument("--friction", choices=FRICTIONS, action="append")
    parser.add_argument("--seconds", type=float, default=DURATION, help="length of each log")
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(5)))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    result: dict[str, list[dict[str, dict[str, dict[str, float]]]]] = {}
    cases = options.scene or SCENES, options.friction or FRICTIONS
    for seed, scene, friction in itertools.product(options.seeds, *cases):
        found = scores(scene, friction, seed, options.seconds)
        result.setdefault(f"{scene}, {friction}", []).append(found)
        print(scene, friction, seed, json.dumps(found), flush=True)
    lines = []
    for case, seeds in result.items():
        for state in seeds[0]:
            for method in seeds[0][state]:
                own = [seed[state][method] for seed in seeds]
                keys = ("rmse_N", "median_std_N", "coverage")
                means = [sum(x[k] for x in own) / len(own) if k in own[0] else None for k in keys]
                lines.append([case, state, method, *("–" if x is None else f"{x:.2f}" for x in means)])
    print(table(["scene, friction", "tip", "method", "RMSE [N]", "median σ [N]", "coverage of ±2σ"], lines))
    print(table(["tip", "method", "RMSE ÷ friction", "worst case", "σ ÷ RMSE", "coverage"], pooled(result)))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
