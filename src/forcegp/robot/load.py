"""Robots from URDF files, read by yourdfpy behind a parser that expands no entities."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import torch

from forcegp.robot.model import BASE, RobotModel

BUNDLED = ("kuka_iiwa",)


def load_robot(
    source,
    *,
    base_position=(0.0, 0.0, 0.0),
    base_rpy=(0.0, 0.0, 0.0),
    gravity=(0.0, 0.0, -9.81),
    dtype=torch.float64,
    device="cpu",
) -> RobotModel:
    import yourdfpy
    from scipy.spatial.transform import Rotation

    path = files("forcegp.robot") / "bundled" / f"{source}.urdf" if str(source) in BUNDLED else Path(source)
    urdf = yourdfpy.URDF.load(
        str(path), build_scene_graph=False, load_meshes=False, build_collision_scene_graph=False
    ).robot
    links = {l.name: l for l in urdf.links}
    children = {}
    for j in urdf.joints:
        children.setdefault(j.parent, []).append(j)
    root = next(l for l in links if l not in {j.child for j in urdf.joints})
    names, types, parents, place, axes, dyn = [], [], [], [], [], []
    frames = []
    bodies = []

    def visit(link, joint, T):
        frames.append((link, joint, T))
        inertial = links[link].inertial
        if inertial is not None and joint != BASE:
            X = T @ (np.eye(4) if inertial.origin is None else inertial.origin)
            bodies.append((joint, inertial.mass, X[:3, 3], X[:3, :3] @ inertial.inertia @ X[:3, :3].T))
        for j in children.get(link, []):
            X = T @ (np.eye(4) if j.origin is None else j.origin)
            if j.type == "fixed":
                visit(j.child, joint, X)
            else:
                names.append(j.name)
                types.append("prismatic" if j.type == "prismatic" else "revolute")
                parents.append(joint)
                place.append(X)
                axes.append(np.array(j.axis) / np.linalg.norm(j.axis))
                dyn.append(
                    (
                        float(j.dynamics.damping or 0.0) if j.dynamics else 0.0,
                        float(j.dynamics.friction or 0.0) if j.dynamics else 0.0,
                        j.limit.effort if j.limit and j.limit.effort else np.inf,
                        j.limit.velocity if j.limit and j.limit.velocity else np.inf,
                    )
                )
                visit(j.child, len(names) - 1, np.eye(4))

    visit(root, BASE, np.eye(4))
    n = len(names)
    mass, moment = np.zeros(n), np.zeros((n, 3))
    for b, m, c, _ in bodies:
        mass[b] += m
        moment[b] += m * c
    com = moment / mass[:, None]
    inertia = np.zeros((n, 3, 3))
    for b, m, c, I in bodies:
        d = c - com[b]
        inertia[b] += I + m * (d @ d * np.eye(3) - np.outer(d, d))

    def t(x):
        return torch.tensor(np.asarray(x), dtype=dtype, device=device)

    place, dyn = np.array(place), np.array(dyn)
    return RobotModel(
        name=str(urdf.name), joint_names=tuple(names), joint_types=tuple(types), parents=tuple(parents),
        placement_rotation=t(place[:, :3, :3]), placement_position=t(place[:, :3, 3]), axis=t(axes),
        mass=t(mass), com=t(com), inertia=t(inertia), damping=t(dyn[:, 0]), friction=t(dyn[:, 1]), stribeck=t(np.zeros(n)), stribeck_velocity=t(np.full(n,.1)), friction_velocity=t(np.full(n,.1)), armature=t(np.zeros(n)),
        lower=t(np.full(n, -np.inf)), upper=t(np.full(n, np.inf)),
        velocity_limit=t(dyn[:, 3]), effort_limit=t(dyn[:, 2]),
        frame_names=tuple(f[0] for f in frames), frame_parents=tuple(f[1] for f in frames),
        frame_rotation=t([f[2][:3, :3] for f in frames]), frame_position=t([f[2][:3, 3] for f in frames]),
        base_rotation=t(Rotation.from_euler("xyz", base_rpy).as_matrix()), base_position=t(base_position),
        gravity=t(gravity),
    )
