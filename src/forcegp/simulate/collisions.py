"""Distances between robot links, contact surfaces and boxes, computed by MuJoCo.

The parts of the links (`robot/shapes.py`) and the surroundings are convex solids. Pairs of bodies that
overlap in most positions, such as neighbouring links, are ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import ParameterError, optional_module
from forcegp.robot.model import BASE, RobotModel
from forcegp.robot.shapes import Shape
from forcegp.simulate.contact_solver import geometry_of, tip_of
from forcegp.simulate.urdf import compile_spec, link_name, write_urdf
from forcegp.types import Array

POSITIONS, MOST = 200, 0.5
"""Number of random positions; fraction of these positions in which a pair must overlap to be ignored."""
TIP = 0.005
"""Tip radius for point contacts [m]."""
SURROUNDINGS = "surroundings"


class Collisions:
    """Collisions of the parts of a robot with each other and with their surroundings, given a clearance.

    Args:
        system: the robot, and contacts with the surfaces to avoid.
        shapes: the convex parts of the robot.
        boxes: centres and side lengths of boxes aligned with the world axes, `(k, 6)` [m].
        clearance: minimum distance [m].

    Raises:
        ParameterError: a box does not consist of six finite numbers with positive side lengths.
        ForceGPError: the surface of a contact has no geometry in MuJoCo.
        MissingDependencyError: MuJoCo is not installed.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        shapes: Sequence[Shape],
        boxes: Sequence[Sequence[float]] = (),
        clearance: float = 0.01,
    ) -> None:
        self._mujoco = mujoco = optional_module("mujoco", "Checking a motion for collisions")
        self.boxes, self.clearance = _checked(boxes), clearance
        spec, robot = mujoco.MjSpec.from_string(write_urdf(system.robot)), system.robot
        spec.compiler.fusestatic = False  # otherwise, the surroundings become part of the base
        common = {"contype": 1, "conaffinity": 1, "condim": 1, "margin": clearance, "mass": 0.0}
        for k, shape in enumerate(shapes):
            mesh = spec.add_mesh(name=f"mesh_{k}")
            mesh.uservert = _placed(robot, shape).ravel().tolist()
            body = spec.worldbody if shape.link == BASE else spec.body(link_name(robot, shape.link))
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"mesh_{k}", **common)
        around = spec.worldbody.add_body(name=SURROUNDINGS)
        for sides in self.boxes:
            box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "pos": sides[:3], "size": 0.5 * sides[3:]}
            around.add_geom(**box, **common)
        for contact in (c for c in system.contacts if isinstance(c, SurfaceContact)):
            around.add_geom(**geometry_of(mujoco, contact), **common)
            link, position, radius = tip_of(robot, contact, TIP)
            body = spec.worldbody if link == BASE else spec.body(link_name(robot, link))
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=position, **common)
        self._model = model = compile_spec(spec, robot)
        # The distances of additional contacts of a pair are only approximate.
        model.opt.disableflags |= getattr(mujoco.mjtDisableBit, "mjDSBL_MULTICCD", 0)
        self._data = mujoco.MjData(model)
        self._dof = np.array([model.joint(name).dofadr[0] for name in robot.joint_names])
        names = {link_name(robot, i): joint for i, joint in enumerate(robot.joint_names)}
        bodies = (model.body(k).name for k in range(model.nbody))
        self._names = [f"link of {names[n]}" if n in names else n.replace("world", "base") for n in bodies]
        self._left_out = {
            tuple(sorted(model.body(link_name(robot, k)).id for k in (i, parent) if k != BASE))
            for i, parent in enumerate(robot.parents)
        }
        self._left_out = {(0, *pair) if len(pair) == 1 else pair for pair in self._left_out}
        self._left_out |= self._always_touching(robot)

    def pairs(self, q: Array) -> dict[str, float]:
        """Return the pairs of bodies closer than the clearance at q `(nq,)`, with their distances [m]."""
        distances: dict[str, float] = {}
        for k, pair in self._near(q):
            name = f"{self._names[pair[0]]} and {self._names[pair[1]]}"
            distances[name] = min(float(self._data.contact.dist[k]), distances.get(name, np.inf))
        return distances

    def depth(self, q: Array) -> Array:
        """Return the violation of the clearance `(n,)` [m] at positions `(n, nq)`, or 0 if there is none."""
        lacks = ((self.clearance - self._data.contact.dist[k] for k, _ in self._near(x)) for x in q)
        return np.array([max(lack, default=0.0) for lack in lacks])

    def penalty(self, q: Array, margin: float) -> tuple[float, Array]:
        """Return Σ (1 − distance/margin)² over positions `(n, nq)` and close pairs, and its gradient."""
        self._model.geom_margin[:] = margin
        value, gradient, model, data = 0.0, np.zeros_like(q), self._model, self._data
        jacobian = np.zeros((2, 3, model.nv))
        for row, x in enumerate(q):
            for k, pair in self._near(x, margin, jacobians=True):
                contact = data.contact[k]
                lack = (margin - contact.dist) / margin
                for J, body in zip(jacobian, pair, strict=True):
                    self._mujoco.mj_jac(model, data, J, None, contact.pos, body)
                # ∇d = nᵀ(J₂ − J₁), with the normal n from the first to the second
                along = contact.frame[:3] @ (jacobian[1] - jacobian[0])
                value += lack**2
                gradient[row] -= 2.0 * lack / margin * along[self._dof]
        self._model.geom_margin[:] = self.clearance
        return value, gradient

    def _near(self, q: Array, distance: float | None = None, jacobians: bool = False) -> list[Any]:
        """Return the index of each contact closer than a given distance, and its bodies in MuJoCo's order."""
        data, model = self._data, self._model
        data.qpos[self._dof] = q
        self._mujoco.mj_kinematics(model, data)
        if jacobians:
            self._mujoco.mj_comPos(model, data)
        self._mujoco.mj_collision(model, data)
        if not data.ncon:
            return []
        near = data.contact.dist < (self.clearance if distance is None else distance)
        pairs = model.geom_bodyid[data.contact.geom]
        return [
            (k, (int(a), int(b)))
            for k, (a, b) in enumerate(pairs)
            if near[k] and (min(a, b), max(a, b)) not in self._left_out
        ]

    def _always_touching(self, robot: RobotModel) -> set[tuple[int, ...]]:
        ends = robot.lower.cpu().numpy(), robot.upper.cpu().numpy()
        low, high = (np.nan_to_num(x, posinf=np.pi, neginf=-np.pi) for x in ends)
        counts: dict[tuple[int, ...], int] = {}
        for q in np.random.default_rng(0).uniform(low, high, (POSITIONS, robot.nq)):
            for pair in {tuple(sorted(pair)) for _, pair in self._near(q)}:
                counts[pair] = counts.get(pair, 0) + 1
        return {pair for pair, count in counts.items() if count > MOST * POSITIONS}


def _checked(boxes: Sequence[Sequence[float]]) -> Array:
    valid = all(len(box) == 6 and np.isfinite(box).all() and min(box[3:]) > 0.0 for box in boxes)
    if not valid:
        expected = "six finite numbers: centre x y z and sides x y z, the sides positive [m]"
        raise ParameterError("a box is not valid", expected=expected, got=[list(box) for box in boxes])
    return np.array(boxes, dtype=float).reshape(-1, 6)


def _placed(robot: RobotModel, shape: Shape) -> Array:
    """Return the corners of a part in the coordinates of its MuJoCo body."""
    if shape.link != BASE:
        return shape.points
    return shape.points @ robot.base_rotation.cpu().numpy().T + robot.base_position.cpu().numpy()
