"""`mujoco.sysid`, the identification toolbox of MuJoCo, on the logs of `write_back.py`.

Its own recipe: joint positions and velocities of short rollouts under the logged torques are compared with
the logged ones, normalized per sensor, and `sysid.optimize` minimizes their squares over the inertia of each
body (log-Cholesky factor of its pseudo-inertia), armature, damping and friction loss of each joint. Bounds of
inertias are those of `body_inertia_param`. It needs `absl-py`, `colorama`, `tabulate`, `plotly`, `jinja2`,
`pyyaml` and `narwhals` beside MuJoCo (`pip install "mujoco[sysid]"`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import forcegp
from forcegp.errors import optional_module
from forcegp.robot.model import RobotModel
from forcegp.simulate.urdf import write_urdf

mujoco = optional_module("mujoco", "This benchmark")
STEP, CHUNK, CHUNKS, ITERATIONS = 0.001, 0.2, 50, 40
"""Time step and length of a rollout [s], number of rollouts, and iterations."""
SERVO_CHUNK = 0.5
"""Length of a rollout of servos [s]."""
LARGEST, START = 10.0, 0.1
"""Upper bound and initial value of armature, damping and friction loss, over std τ ÷ (std q̈, std q̇, 1)."""


def specification(robot: RobotModel) -> Any:
    """The robot file with a motor and two sensors per joint."""
    urdf = mujoco.MjSpec.from_string(write_urdf(robot))
    urdf.compile()
    spec = mujoco.MjSpec.from_string(urdf.to_xml())
    spec.option.gravity, spec.option.timestep = robot.gravity.numpy(), STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    for joint in spec.joints:
        spec.add_actuator(name=f"motor_{joint.name}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
        for kind, sensor in (("q", "JOINTPOS"), ("qd", "JOINTVEL")):
            spec.add_sensor(
                name=f"{kind}_{joint.name}",
                type=getattr(mujoco.mjtSensor, f"mjSENS_{sensor}"),
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=joint.name,
            )
    return spec


def with_inertia(spec: Any, body: str, theta: np.ndarray) -> None:
    """Set the inertia of a body by its log-Cholesky parameters, along principal axes.

    The toolbox sets `fullinertia` of a compiled body, which MuJoCo 4.0 rejects.
    """
    from mujoco.sysid._src.model_modifier import pi_from_theta
    from scipy.spatial.transform import Rotation

    mass, *rest = pi_from_theta(theta)
    com, about_origin = np.array(rest[:3]) / mass, np.reshape(rest[3:], (3, 3))
    about_com = about_origin - mass * (com @ com * np.eye(3) - np.outer(com, com))
    moments, axes = np.linalg.eigh(about_com)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    target = spec.body(body)
    target.mass, target.ipos, target.inertia = mass, com, moments
    target.iquat = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    target.fullinertia = [np.nan, 0.0, 0.0, 0.0, 0.0, 0.0]


def recordings(
    spec: Any, log: forcegp.Dataset, chunk: float = CHUNK, inputs: Callable[[float], np.ndarray] | None = None
) -> Any:
    """Rollouts from evenly spaced states of a log, torques held between samples, or inputs at each step."""
    from mujoco import sysid

    model, period = spec.compile(), float(log.t[1] - log.t[0])
    rows, held = round(chunk / period), round(period / STEP)
    states, controls, sensors = [], [], []
    for k in np.linspace(0, len(log) - rows - 1, CHUNKS).astype(int):
        window = slice(k, k + rows)
        states.append(sysid.create_initial_state(model, log.q[k].numpy(), log.qd[k].numpy()))
        control = np.repeat(log.tau[window].numpy(), held, axis=0)
        if inputs is not None:
            control = np.array([inputs(float(log.t[k]) + STEP * i) for i in range(len(control))])
        controls.append(sysid.TimeSeries(STEP * np.arange(len(control)), control))
        measured = np.stack([log.q[window].numpy(), log.qd[window].numpy()], -1).reshape(rows, -1)
        sensors.append(sysid.TimeSeries.from_names(period * np.arange(rows), measured, model))
    names = [f"rollout_{k}" for k in range(CHUNKS)]
    return sysid.ModelSequences("arm", spec, names, states, controls, sensors)


def identified(robot: RobotModel, log: forcegp.Dataset) -> Any:
    """Return the MuJoCo model of a robot file with the parameters that `mujoco.sysid` identifies."""
    optional_module("absl", "mujoco.sysid")
    from mujoco import sysid

    spec = specification(robot)
    model, params = spec.compile(), sysid.ParameterDict()
    for body in model.body(0).id + np.arange(1, model.nbody):
        name = model.body(int(body)).name

        def move(spec: Any, parameter: Any, name: str = name) -> None:
            with_inertia(spec, name, parameter.value)

        params.add(sysid.body_inertia_param(spec, model, name, sysid.InertiaType.Pseudo, modifier=move))
    torque = log.tau.std(0)
    sizes = {"armature": torque / log.qdd.std(0), "damping": torque / log.qd.std(0), "frictionloss": torque}
    for j, joint in enumerate(spec.joints):
        for field, size in sizes.items():

            def change(spec: Any, parameter: Any, joint: str = joint.name, field: str = field) -> None:
                value = [parameter.value[0], 0.0, 0.0] if field == "damping" else parameter.value[0]
                setattr(spec.joint(joint), field, value)

            name, scale = f"{joint.name}_{field}", float(size[j])
            params.add(sysid.Parameter(name, START * scale, 0.0, LARGEST * scale, modifier=change))
    residual = sysid.build_residual_fn(models_sequences=[recordings(spec, log)], n_threads=1)
    found, _ = sysid.optimize(params, residual, verbose=False, max_iters=ITERATIONS)
    return sysid.apply_param_modifiers(found, spec)


def identified_servos(
    robot: RobotModel,
    log: forcegp.Dataset,
    stiffness: np.ndarray,
    damping: np.ndarray,
    commands: Callable[[float], np.ndarray],
) -> Any:
    """Return the MuJoCo model with the scale of each servo, drive, damping and friction loss identified.

    Args:
        stiffness, damping: nominal gains, which the bounds allow to be wrong by a factor of 3.
        commands: commanded positions that act at a time, with their true delay.
    """
    optional_module("absl", "mujoco.sysid")
    from mujoco import sysid

    spec, params = specification(robot), sysid.ParameterDict()

    def gains(spec: Any, joint: str, k: float, d: float) -> None:
        actuator = spec.actuator(f"motor_{joint}")
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0], actuator.biasprm[1], actuator.biasprm[2] = k, -k, -d

    torque = log.tau.std(0)
    sizes = {"armature": torque / log.qdd.std(0), "damping": torque / log.qd.std(0), "frictionloss": torque}
    for j, joint in enumerate(robot.joint_names):
        gains(spec, joint, stiffness[j], damping[j])

        def scale(spec: Any, parameter: Any, j: int = j, joint: str = joint) -> None:
            gains(spec, joint, parameter.value[0] * stiffness[j], parameter.value[0] * damping[j])

        params.add(sysid.Parameter(f"{joint}_scale", 1.0, 1.0 / 3.0, 3.0, modifier=scale))
        for field, size in sizes.items():

            def change(spec: Any, parameter: Any, joint: str = joint, field: str = field) -> None:
                value = [parameter.value[0], 0.0, 0.0] if field == "damping" else parameter.value[0]
                setattr(spec.joint(joint), field, value)

            name, most = f"{joint}_{field}", float(size[j])
            params.add(sysid.Parameter(name, START * most, 0.0, LARGEST * most, modifier=change))
    sequences = recordings(spec, log, SERVO_CHUNK, commands)
    residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=1)
    found, _ = sysid.optimize(params, residual, verbose=False, max_iters=ITERATIONS)
    return sysid.apply_param_modifiers(found, spec)
