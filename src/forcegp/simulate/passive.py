"""Learned forces as a MuJoCo callback for passive forces, for use in any simulation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, check_name, optional_module
from forcegp.forces.quantities import ForceField, states_at
from forcegp.resources import one_thread


class PassiveForces:
    """A force field as the callback `mjcb_passive`, which adds Q̄ − Q_C − Q_G − Q_u to `qfrc_passive`.

    If the MuJoCo model has the masses and drives of the fitted robot (`fit.system.robot`), its acceleration
    is M⁻¹Q̄, as predicted by the fit. Q̄ includes joint friction, so `installed` temporarily removes damping
    and friction loss from the model. Learned contact friction is not applied, since the engine models contact
    friction itself. Q_u is the sum of `qfrc_applied` and the last actuator forces.

    Args:
        system: the system with the fitted robot.
        field: `fit.force_field()`, or a posterior sample, `fit.force_samples(1, generator)`.
        joint_names: names of the joints in the MuJoCo model. The default is those of the robot.

    Raises:
        ModelError: the number of names differs from the number of joints.

    Example:
        `with PassiveForces(fit.system, fit.force_field()).installed(model): mujoco.mj_step(model, data)`
    """

    def __init__(
        self, system: ConstrainedSystem, field: ForceField, joint_names: Sequence[str] | None = None
    ) -> None:
        self.system, self.field = system, field
        self.joint_names = tuple(joint_names or system.robot.joint_names)
        if len(self.joint_names) != system.robot.nq:
            text = "the joint names do not match the robot"
            expected = f"{system.robot.nq} names in the order of {', '.join(system.robot.joint_names)}"
            raise ModelError(text, expected=expected, got=", ".join(self.joint_names))

    def __call__(self, model: Any, data: Any) -> None:
        """Add the forces at the current state of `data`."""
        dof, qpos = self._places(model)
        tau = data.qfrc_applied[dof] + data.qfrc_actuator[dof]
        data.qfrc_passive[dof] += self.force(data.qpos[qpos], data.qvel[dof], tau)

    @torch.no_grad()
    def force(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return the force to add at a state, `(nq,)` [N m, N]."""
        q_, qd_, tau_ = (torch.tensor(x, dtype=self.system.robot.dtype)[None] for x in (q, qd, tau))
        open_ = torch.zeros(1, len(self.system.contacts), dtype=torch.bool)
        with one_thread():
            at, _ = states_at(self.system, q_, qd_, tau_, open_)
            force = self.field(self.system, at) - at.eom.Q_C - at.eom.Q_G - at.tau
        return force[0].double().numpy()

    def _places(self, model: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of the joints' degrees of freedom and positions in a model."""
        known = [model.joint(k).name for k in range(model.njnt)]
        for name in self.joint_names:
            check_name("joint of the MuJoCo model", name, known)
        joints = [model.joint(name) for name in self.joint_names]
        return np.array([j.dofadr[0] for j in joints]), np.array([j.qposadr[0] for j in joints])

    @contextmanager
    def installed(self, model: Any) -> Iterator[None]:
        """Install the callback for all simulations within the block, and disable the model's joint friction.

        Raises:
            UnknownNameError: a joint of the robot is not in the model.
        ModelError: a DC motor of the model has LuGre friction.
        """
        mujoco = optional_module("mujoco", "Learned forces in a simulation")
        dof, _ = self._places(model)
        motor = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR
        if (motor & (model.actuator_dynprm[:, 5] > 0.0)).any():
            raise ModelError(
                "a DC motor of the MuJoCo model has LuGre friction, which cannot be switched off",
                expected="a model without lugre, since the learned forces contain friction",
                hint="load the original robot file",
            )
        names = "dof_damping", "dof_dampingpoly", "dof_frictionloss"
        kept = {name: getattr(model, name)[dof] for name in names}
        before = mujoco.get_mjcb_passive()
        for name in names:
            getattr(model, name)[dof] = 0.0
        mujoco.set_mjcb_passive(self)
        try:
            yield
        finally:
            mujoco.set_mjcb_passive(before)
            for name, values in kept.items():
                getattr(model, name)[dof] = values
