"""The paper's task: a KUKA iiwa slides over a table, with contact friction that the model lacks.

python examples/kuka_on_the_table.py [figure.png]
"""

# %% A bundled scene, and three seconds of simulated motion
import sys

import forcegp
from forcegp.simulate import SimulationConfig, simulate

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "kuka_on_the_table.png")
system = forcegp.load_scene("kuka_plane").system()
data = simulate(system, SimulationConfig(duration=3.0)).data
train, test = data[:480:4], data[480:]
print(data)

# %% Gaussian processes on the unknown forces, around those of the robot file, fitted to 120 samples
fit = forcegp.StructuredGP(system, mean="analytical").fit(train)
print(fit)

# %% Predicted accelerations and normal force on the last second, which the model has not seen
acceleration = fit.predict(test.q, test.qd, test.tau)
force = fit.predict(test.q, test.qd, test.tau, quantity="multiplier")
file = forcegp.AnalyticalModel(system).nominal().predict(test.q, test.qd, test.tau)
error, before = ((x.mean - test.qdd_clean).abs().mean() for x in (acceleration, file))
print(f"acceleration: mean error {error:.3f} rad/s2, of the robot file alone {before:.3f}")
true = test.multiplier["table"].mean()
print(f"normal force: {force.mean.mean():.1f} +- {2 * force.std.mean():.1f} N on average, true {true:.1f} N")

# %% The motion of the next half second from one state, with the spread of five drawn force functions
path = fit.rollout(test.q[0], test.qd[0], test, duration=0.5, samples=5)
tip = ("lbr_iiwa_link_7", (0.0, 0.0, 0.1))
logged = forcegp.kinematics.point_position(system.robot, test.q[: len(path.t)], *tip)
off = 1e3 * (path.tip(*tip)[-1] - logged[-1]).norm()
print(f"tip after 0.5 s: {off:.1f} mm off, and {path.drift.abs().max():.0e} m or less from the table")
fit.plot(test, "multiplier")[0].figure.savefig(figure, dpi=150)
print(f"figure: {figure}")
