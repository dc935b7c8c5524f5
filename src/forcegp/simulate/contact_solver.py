"""MuJoCo with its own contact solver, which models contact and dry friction independently of this library."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from forcegp.constraints import ConstrainedSystem, SurfaceContact
from forcegp.errors import ForceGPError, UnsupportedRobotError, optional_module
from forcegp.robot.model import BASE, RobotModel
from forcegp.robot.shapes import turn_z
from forcegp.simulate.config import ContactSolver
from forcegp.simulate.engines import NEEDS_MUJOCO, MuJoCoWorld
from forcegp.simulate.urdf import compile_spec, link_name, write_urdf

IMPEDANCE = [0.01, 0.95, 0.0002, 0.5, 2.0]
"""Parameters of MuJoCo's impedance, which grows from almost zero within 0.2 mm to avoid force jumps."""
SOLVED = 1e-15
"""Solver tolerance at which forces and accelerations satisfy Newton's equations to within rounding errors."""
NO_FORCE = 1e-9
"""Normal force below which a contact counts as open [N]."""


class SolvedForces(NamedTuple):
    """Result of the engine's solver at a state for a given torque.

    Attributes:
        qdd: acceleration, `(nq,)` [rad/s², m/s²].
        Q: joint forces without contact forces, Q_C + Q_G + Q_u and joint friction, `(nq,)` [N m].
        Q_I, Q_z: generalized normal and friction forces of the contacts, `(nq,)` [N m].
        multiplier: normal forces, `(n_contacts,)` [N].
        F_I, F_z: normal and friction forces on the tip in world axes, `(n_contacts, 3)` [N].
    """

    qdd: np.ndarray
    Q: np.ndarray
    Q_I: np.ndarray
    Q_z: np.ndarray
    multiplier: np.ndarray
    F_I: np.ndarray
    F_z: np.ndarray


class ContactSolverEngine(MuJoCoWorld):
    """A robot in a MuJoCo world with solid surfaces and rounded tips, driven only by motor torques.

    Contact surfaces must be planes, spheres or cylinders. Torques are held for the sampling period dt [s].

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        ForceGPError: a constraint has no geometry, or friction is given for the wrong number of joints.
        UnsupportedRobotError: the robot file declares Stribeck friction, which MuJoCo does not model.
    """

    def __init__(self, system: ConstrainedSystem, dt: float, solver: ContactSolver) -> None:
        mujoco, robot = optional_module("mujoco", NEEDS_MUJOCO), system.robot
        self._substeps = solver.substeps(dt)
        super().__init__(robot, _compile(mujoco, system, solver), dt / self._substeps)
        options = self.model.opt
        options.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        options.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        options.tolerance = SOLVED
        damping, friction = (_per_joint(robot, solver, name) for name in ("joint_damping", "joint_friction"))
        self.model.dof_damping[self._dof] = robot.damping.numpy() + damping
        if robot.drag is not None:
            self.model.dof_dampingpoly[self._dof] = robot.drag.numpy()
        self.model.dof_frictionloss[self._dof] = robot.friction.numpy() + friction
        geom = self.model.geom
        self._pairs = [(geom(f"surface_{i}").id, geom(f"tip_{i}").id) for i in range(len(system.contacts))]

    @property
    def name(self) -> str:
        return f"{super().name}, contact solver"

    def forces(self, torque: np.ndarray) -> SolvedForces:
        """Return the acceleration and forces at the current state under a motor torque `(nq,)` [N m].

        The engine evaluates viscous friction at the end of the step, (M + h D) q̈ = Q(q, q̇). For joints with
        low inertia, the result differs considerably from M⁻¹Q. The returned q̈ and friction are those of the
        step, in which the velocity changes by h q̈.
        """
        data, dof = self._data, self._dof
        data.qfrc_applied[dof] = torque
        self._mujoco.mj_forward(self.model, data)
        # D = d + 2 b |q̇| + 3 c q̇²
        slopes = np.stack([2.0 * np.abs(data.qvel), 3.0 * data.qvel**2], axis=-1)
        D = self.model.dof_damping + (self.model.dof_dampingpoly * slopes).sum(-1)
        M, hD = self._mass_matrix(data), self.model.opt.timestep * D
        qdd = np.linalg.solve(M + np.diag(hD), M @ data.qacc)
        contacts = [self._contact_force(*pair) for pair in self._pairs]
        none = np.zeros((0, 2, len(dof))), np.zeros((0, 2, 3))
        Q, F = (np.stack(part) for part in zip(*contacts, strict=True)) if contacts else none
        Q_I, Q_z = Q.sum(0)
        whole = data.qfrc_applied + data.qfrc_passive + data.qfrc_constraint - data.qfrc_bias
        others, (F_I, F_z) = (whole - hD * qdd)[dof] - Q_I - Q_z, F.swapaxes(0, 1)
        return SolvedForces(qdd[dof], others, Q_I, Q_z, np.linalg.norm(F_I, axis=-1), F_I, F_z)

    def step(self) -> None:
        """Advance by one sampling period under the torque that was last passed to `forces`."""
        self._mujoco.mj_step(self.model, self._data, self._substeps)

    def _contact_force(self, surface: int, tip: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the normal and friction forces on a tip, generalized `(2, nq)` and Cartesian `(2, 3)`."""
        model, data = self.model, self._data
        Q, F = np.zeros((2, len(self._dof))), np.zeros((2, 3))
        wrench, jacobian = np.zeros(6), np.zeros((3, model.nv))
        for i in range(data.ncon):
            contact = data.contact[i]
            if {contact.geom1, contact.geom2} != {surface, tip}:
                continue
            # MuJoCo returns the force on its second geometry; the first axis is the normal towards it.
            sign = 1.0 if contact.geom2 == tip else -1.0
            self._mujoco.mj_contactForce(model, data, i, wrench)
            axes = sign * contact.frame.reshape(3, 3)
            self._mujoco.mj_jac(model, data, jacobian, None, contact.pos, int(model.geom_bodyid[tip]))
            for part, force in enumerate((wrench[0] * axes[0], wrench[1:3] @ axes[1:])):
                F[part] += force
                Q[part] += (jacobian.T @ force)[self._dof]
        return Q, F


def _compile(mujoco: Any, system: ConstrainedSystem, solver: ContactSolver) -> Any:
    """Compile the robot with a tip and a surface for each contact. Only these pairs can collide."""
    robot = system.robot
    spec = mujoco.MjSpec.from_string(write_urdf(robot))
    for i, contact in enumerate(system.contacts):
        if not isinstance(contact, SurfaceContact):
            text = f"the contact solver has no geometry for the constraint {contact.name!r}"
            hint = 'use contact = "rigid"'
            raise ForceGPError(text, expected="contacts of a point with a surface", hint=hint)
        body, position, radius = tip_of(robot, contact, solver.tip_radius)
        ghost = {"contype": 0, "conaffinity": 0, "mass": 0.0}
        link = spec.worldbody if body == BASE else spec.body(link_name(robot, body))
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        link.add_geom(name=f"tip_{i}", type=sphere, size=[radius, 0, 0], pos=position, **ghost)
        spec.worldbody.add_geom(name=f"surface_{i}", **geometry_of(mujoco, contact), **ghost)
        pair = spec.add_pair(geomname1=f"surface_{i}", geomname2=f"tip_{i}")
        pair.condim = 3
        pair.friction = [solver.friction, solver.friction, 0.0, 0.0, 0.0]
        pair.solref = [solver.stiffness_time, 1.0]
        pair.solimp = IMPEDANCE
    return compile_spec(spec, robot)


def _per_joint(robot: RobotModel, solver: ContactSolver, name: str) -> np.ndarray:
    values = getattr(solver, name)
    if len(values) not in (0, robot.nq):
        text = f"{name} has the wrong length for the robot"
        raise ForceGPError(text, expected=f"{robot.nq} numbers", got=values)
    if bool((robot.stribeck != 0.0).any()):
        text = f"robot {robot.name!r} declares Stribeck friction, which MuJoCo does not model"
        raise UnsupportedRobotError(text, hint='use contact = "rigid"')
    return np.array(values or [0.0] * robot.nq)


def tip_of(robot: RobotModel, contact: SurfaceContact, radius: float) -> tuple[int, np.ndarray, float]:
    """Return the link of the tip, the centre of the tip in link coordinates, and the radius of the tip.

    For a point contact, the tip is a sphere that ends at the point. It is centred on the line from the point
    to the origin of the frame.
    """
    index = robot.frame_index(contact.frame)
    center = np.array(contact.point, dtype=float)
    if contact.radius > 0.0:
        radius = contact.radius
    else:
        length = float(np.linalg.norm(center))
        center = center - radius * (center / length if length > 0.0 else np.array([0.0, 0.0, 1.0]))
    R, p = robot.frame_rotation[index].numpy(), robot.frame_position[index].numpy()
    return robot.frame_parents[index], p + R @ center, radius


def geometry_of(mujoco: Any, contact: SurfaceContact) -> dict[str, Any]:
    """Return the type, size and pose of the MuJoCo geometry for a contact surface."""
    solid = contact.surface.solid()
    if solid is None:
        text = f"the contact solver has no geometry for the surface of {contact.name!r}"
        expected, hint = "a surface with `solid`, such as a plane", 'use contact = "rigid"'
        raise ForceGPError(text, expected=expected, got=type(contact.surface).__name__, hint=hint)
    # The quaternion (w, x, y, z) of a rotation that turns z into the axis.
    turned = Rotation.from_matrix(turn_z(np.array(solid.axis))).as_quat()[[3, 0, 1, 2]]
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{solid.shape.upper()}")
    return {"type": kind, "size": [*solid.size], "pos": [*solid.position], "quat": turned}
