"""False alarms of `forcegp check` on clean logs: robots, motions, seeds and engines.

Every warning and every error on these logs is false, but for those in `TRUE`. Run from the repository root:
`PYTHONPATH=tests python benchmarks/check_clean.py --out clean.json`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import forcegp
from forcegp.checks import check, log_of
from forcegp.constraints import ConstrainedSystem
from forcegp.scene import load_scene
from forcegp.simulate import simulate
from planted_faults import Case, free_log

SOLVER = {"engine": "mujoco", "contact": "solver"}
ROBOTS = ("double_pendulum", "franka_panda", "kuka_iiwa", "kuka_iiwa14", "ur5")
TRUE = {
    "pendulum_wire": {"force-directions"},
    "panda_sphere": {"joint-still"},
    "panda_tilted": {"joint-still"},
    "ur5_free": {"joint-still"},
    "friction": {"friction-undeclared"},
}
"""What is true of a scene or a group: the wire is a single line, a joint hardly moves in some logs, and the
robot file does not declare the friction."""


@dataclass(frozen=True)
class Clean:
    """A log without a fault.

    Attributes:
        group: kind of log in the table of benchmarks/notes/checking.md.
        scene: bundled scene, or bundled robot that moves freely.
        seed: of the motion and the noise.
        settings: of the simulation, over those of the scene.
    """

    group: str
    scene: str
    seed: int
    settings: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the log in the result."""
        return f"{self.group}: {self.scene}, seed {self.seed}"

    def make(self) -> Case:
        """Simulate it."""
        if self.group == "free":
            robot = forcegp.load_robot(self.scene)
            return ConstrainedSystem(robot, []), free_log(robot, seed=self.seed)
        scene = load_scene(self.scene)
        system, config = scene.system(), replace(scene.simulation, seed=self.seed, duration=14.0)
        if self.group == "friction":
            return system, log_of(simulate(system, replace(config, **self.settings)).data)
        if self.group == "solver":
            # Friction that the robot file does not declare would be a true finding.
            solver = replace(config.solver, joint_friction=(), joint_damping=())
            config = replace(config, solver=solver)
        return system, log_of(simulate(system, replace(config, **self.settings)).data)


def solver_logs(seeds: range) -> Iterator[Clean]:
    """Raw logs of MuJoCo's contact solver without joint friction."""
    for scene in ("ur5_wiping", "panda_sphere", "panda_tilted", "kuka_plane", "kuka_sphere"):
        for seed in seeds:
            yield Clean("solver", scene, seed, {**SOLVER, "lift_probability": 0.2})


def friction_logs(seeds: range) -> Iterator[Clean]:
    """Logs of MuJoCo's solver with joint friction that the robot file does not declare."""
    for scene in ("ur5_free", "ur5_wiping"):
        for seed in (2 * seed + k for seed in seeds for k in (0, 1)):
            yield Clean("friction", scene, seed, {"duration": (12.0, 60.0)[seed % 2]})


def rigid_logs(seeds: range) -> Iterator[Clean]:
    """Contact by this library's equations of motion, on both engines."""
    for scene in ("kuka_plane", "kuka_sphere", "panda_tilted", "pendulum_wire"):
        for seed in seeds:
            engine = ("mujoco", "pybullet")[seed % 2]
            yield Clean("rigid", scene, seed, {"engine": engine, "lift_probability": 0.15})


def free_logs(seeds: range) -> Iterator[Clean]:
    """Free motion of every bundled arm."""
    for robot in ROBOTS:
        for seed in seeds:
            yield Clean("free", robot, seed, {})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--group", choices=("free", "rigid", "solver", "friction"), action="append")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=2, help="seeds per scene")
    options = parser.parse_args()
    seeds, makers = (
        range(options.seed, options.seed + options.seeds),
        (free_logs, rigid_logs, solver_logs, friction_logs),
    )
    result = {}
    for case in (case for maker in makers for case in maker(seeds)):
        if options.group is None or case.group in options.group:
            report = check(*case.make())
            serious = (finding for finding in report.findings if finding.severity != "note")
            alarms = {kind: finding.message for finding in serious for kind in finding.kinds}
            true = TRUE.get(case.scene, set()) | TRUE.get(case.group, set())
            result[case.name] = {kind: text for kind, text in alarms.items() if kind not in true}
            print(case.name, result[case.name] or "silent", flush=True)
    false = sum(bool(alarms) for alarms in result.values())
    print(f"{false} of {len(result)} clean logs with a false alarm")
    options.out.write_text(json.dumps(result, indent=2, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
