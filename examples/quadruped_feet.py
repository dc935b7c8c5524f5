"""A quadruped stands, sways and trots: the force on each foot with error bars, without foot sensors.

    python examples/quadruped_feet.py [figure.png] [--view feet.html]

The log holds joint positions, torques, an IMU and the pose of the base. The Solo12 in MuJoCo has friction,
drives and a payload that its file lacks. Requires the extras `mujoco` and `test` (for example-robot-data).
"""

# %% Solo12 with balls for feet, on a floor
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import cmeel
import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation

import forcegp
from forcegp.logs import parse_mapping

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "quadruped_feet.png")
robots = Path(next(iter(cmeel.__path__))).parent / "cmeel.prefix/share/example-robot-data/robots"
file, FEET, RADIUS = robots / "solo_description/robots/solo12.urdf", ["FL", "FR", "HL", "HR"], 0.016
root = ElementTree.parse(file).getroot()
for link in root.findall("link"):
    for shape in (*link.findall("visual"), *link.findall("collision")):
        link.remove(shape)
ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", fusestatic="false")
spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
spec.worldbody.first_body().add_freejoint()
floor = {"solref": [0.005, 1.0], "friction": [0.8, 0.005, 0.0001]}
spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9.0, 9.0, 0.1], **floor)
for foot in FEET:
    ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [RADIUS, 0.0, 0.0], "mass": 0.0}
    spec.body(f"{foot}_FOOT").add_geom(**ball, **floor)
spec.option.timestep, spec.option.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
world = spec.compile()
world.body_mass[world.jnt_bodyid[0]] += 0.25
world.dof_frictionloss[6:], world.dof_damping[6:], world.dof_solref[:, 0] = 0.06, 0.015, 0.002
world.dof_armature[6:] = 5e-4
mujoco.mj_setConst(world, mujoco.MjData(world))

# %% Two seconds of standing, eight of swaying and ten of a trot, with noisy readings at 500 Hz
DT, SECONDS, LEG = 0.002, 20.0, 0.16  # [s], [s], length of thigh and shank [m]


def posture(t: float) -> np.ndarray:
    """Angles of hip, thigh and knee of each leg `(12,)` that place its foot below the hip."""
    sway = np.sin(np.pi * np.clip((t - 2.0) / 8.0, 0.0, 1.0)) * np.sin(
        2.0 * np.pi * t * np.array([0.7, 0.9, 1.3, 0.5])
    )
    phase = (1.8 * t + np.array([0.0, 0.5, 0.5, 0.0])) % 1.0
    swing, ramp = np.clip((phase - 0.55) / 0.45, 0.0, 1.0), np.clip(t - 10.0, 0.0, 1.0)
    along = np.where(phase < 0.55, 0.5 - phase / 0.55, swing**2 * (3.0 - 2.0 * swing) - 0.5)
    front, left = np.array([1.0, 1.0, -1.0, -1.0]), np.array([1.0, -1.0, 1.0, -1.0])
    x = 0.02 * sway[0] + ramp * 0.04 * along
    z = 0.22 + 0.015 * (sway[1] + front * sway[2]) - ramp * 0.04 * np.sin(np.pi * swing) ** 2
    bend = front * np.arccos(np.hypot(x, z) / (2.0 * LEG))
    hip = 0.12 * sway[3] + 0.03 * left * sway[0]
    return np.stack([hip, bend - np.arctan2(x, z), -2.0 * bend], axis=1).ravel()


random, state, wrench = np.random.default_rng(0), mujoco.MjData(world), np.zeros(6)
state.qpos[7:] = posture(0.0)
mujoco.mj_kinematics(world, state)
state.qpos[2] += RADIUS - min(state.body(f"{foot}_FOOT").xpos[2] for foot in FEET)
rows, truth = [], []
for t in np.arange(0.0, SECONDS, DT):
    speed = (posture(t) - posture(t - DT)) / DT
    tau = 8.0 * (posture(t) - state.qpos[7:]) + 0.24 * (speed - state.qvel[6:])
    state.qfrc_applied[6:] = tau
    mujoco.mj_forward(world, state)
    force = dict.fromkeys(FEET, 0.0)
    for i, contact in enumerate(state.contact):
        mujoco.mj_contactForce(world, state, i, wrench)
        force[world.body(world.geom_bodyid[contact.geom2]).name[:2]] += wrench[0]
    R, q, v = Rotation.from_quat(np.roll(state.qpos[3:7], -1)), state.qpos, state.qvel
    f = R.inv().apply(state.qacc[:3] - world.opt.gravity)  # accelerometer
    readings = q[:3], q[3:7], v[:3], v[3:6], f, q[7:], tau
    sizes = 1e-4, 0.0, 2e-3, 4e-3, 0.03, 2e-5, 0.01
    noisy = [x + std * random.standard_normal(len(x)) for x, std in zip(readings, sizes, strict=True)]
    rows.append(np.concatenate([[t], *noisy]))
    truth.append(list(force.values()))
    for _ in range(4):
        mujoco.mj_step(world, state)

# %% Import: the base becomes six joints, and each foot is a contact that the equations of motion find closed
joints = [world.joint(k).name for k in range(1, 13)]
names = {"p": "xyz", "r": "wxyz", "v": "xyz", "w": "xyz", "f": "xyz"} | dict.fromkeys(["q", "tau"], joints)
header = ",".join(["t", *(f"{name}.{part}" for name, parts in names.items() for part in parts)])
three = {name: [f"{name}.{axis}" for axis in "xyz"] for name in "pvwf"}
mapping = f"""
time = {{ column = "t" }}
position = {{ column = "q.{{joint}}", unit = "rad" }}
torque = {{ column = "tau.{{joint}}", unit = "Nm" }}
base = {{ position = {three["p"]}, quaternion = ["r.w", "r.x", "r.y", "r.z"], quaternion_order = "wxyz", \
linear_velocity = {three["v"]}, linear_axes = "world", imu_frame = "base_link", gyro = {three["w"]}, \
accelerometer = {three["f"]}, gravity = true }}
"""
mapping += "".join(f'[contact.{foot}]\nsource = "multiplier"\n' for foot in FEET)
robot, plane = forcegp.load_robot(file, base="free"), forcegp.Plane(offset=0.0)
feet = [forcegp.SurfaceContact(x, f"{x}_FOOT", (0.0, 0.0, 0.0), plane, radius=RADIUS) for x in FEET]
system = forcegp.ConstrainedSystem(robot, feet)
with tempfile.TemporaryDirectory() as folder:
    np.savetxt(f"{folder}/log.csv", rows, "%.9g", ",", header=header, comments="")
    data = forcegp.read_log(f"{folder}/log.csv", system, parse_mapping(mapping.encode(), "mapping"))
print(data)

# %% Fit every tenth row of the first 17 s, and read the feet in the last three
fit = forcegp.StructuredGP(system).fit(data[data.t < 17.0][::10])
print(fit)
test = data[data.t >= 17.0]
true = torch.tensor(truth)[(test.t / DT).round().long()]
read = fit.contact_force(test)
vertical = [read.parts[foot].start + 2 for foot in FEET]
force, std = read.mean[:, vertical], read.std[:, vertical]
closed, impact = test.active(FEET), torch.stack([test.impact[foot] for foot in FEET]).amax(0) > 0.0
quiet = closed & ~impact[:, None]  # the filter for accelerations smooths the rows around an impact
error = (force - true)[quiet]
inside = (error.abs() <= 2.0 * std[quiet]).double().mean()
print(f"labels agree with MuJoCo in {(closed == (true > 0.0)).double().mean():.1%} of the rows")
print(f"vertical force of closed feet: {true[quiet].mean():.2f} N on average, "
      f"error {error.square().mean().sqrt():.2f} N, within 2 sigma {inside:.0%}")  # fmt: skip

# %%
fig, axes = plt.subplots(4, 1, figsize=(7, 7), sharex=True, sharey=True, layout="constrained")
for k, (ax, foot) in enumerate(zip(axes, FEET, strict=True)):
    low, high = force[:, k] - 2.0 * std[:, k], force[:, k] + 2.0 * std[:, k]
    ax.fill_between(test.t, low, high, alpha=0.3, label="±2σ")
    ax.plot(test.t, force[:, k], label="from motion and torques")
    ax.plot(test.t, true[:, k], "k--", lw=0.8, label="MuJoCo")
    ax.set_ylabel(f"{foot} [N]")
axes[0].set(xlim=(17.0, 18.5), ylim=(-2.0, 26.0))
axes[0].legend(ncols=3, loc="upper right")
axes[-1].set_xlabel("time [s]")
fig.savefig(figure, dpi=150)

# %% A page with the robot and the normal forces in 3D
if "--view" in sys.argv:
    from forcegp.robot.shapes import shapes_of
    from forcegp.view.motion import of_log
    from forcegp.view.page import write_view

    shown = test.replace(contact_extras={"multiplier": dict(zip(FEET, force.T, strict=True))})
    write_view(sys.argv[sys.argv.index("--view") + 1], of_log(system, shown), shapes_of(robot, file))
print(f"figure: {figure}")
