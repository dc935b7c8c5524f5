"""A UR5 wipes a table: the contact force with error bars, from joint torques and motion alone.

    python examples/ur5_wiping.py [figure.png]

MuJoCo's own solver makes contact and friction, so that the truth is not made of the model's equations. The
joints have Coulomb and viscous friction that the robot file does not declare.
"""

# %% Eight seconds of wiping, with lifts
import dataclasses
import sys

import forcegp
from forcegp.forces.priors.sets import friction_priors
from forcegp.simulate import simulate

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "ur5_wiping.png")
scene = forcegp.load_scene("ur5_wiping")
system = scene.system()
data = simulate(system, dataclasses.replace(scene.simulation, duration=8.0)).data
train, test = data[:1250:10], data[1250:]
print(data)

# %% Priors on the friction of each joint and of the contact; the noise is learned
fit = forcegp.StructuredGP(system, "analytical", friction_priors(system)).fit(train)
print(fit)

# %% The normal force of the last three seconds beside MuJoCo's, which the model has never seen
# The band counts the noise of the torque that the force is read from.
closed = test.contact["table"]
force = fit.predict(test.q, test.qd, test.tau, "multiplier", active=closed[:, None], noise=True)
error = (force.mean[:, 0] - test.multiplier["table"])[closed]
inside = error.abs() <= 2.0 * force.std[closed, 0]
alone = forcegp.AnalyticalModel(system).nominal().predict(test.q, test.qd, test.tau, "multiplier")
before = (alone.mean[:, 0] - test.multiplier["table"])[closed]
print(f"{int(closed.sum())} samples in contact, {test.multiplier['table'][closed].mean():.1f} N on average")
print(f"robot file alone: bias {before.mean():+.2f} N, standard deviation {before.std():.2f} N")
print(f"model: bias {error.mean():+.2f} N, standard deviation {error.std():.2f} N, "
      f"within 2 sigma {inside.double().mean():.0%}")  # fmt: skip
fit.plot(test, "multiplier")[0].figure.savefig(figure, dpi=150)
print(f"figure: {figure}")
