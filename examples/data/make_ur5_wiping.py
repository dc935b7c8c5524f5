"""Write `ur5_wiping.csv`: a UR5 that wipes a table, as a robot's own recorder would log it.

    python examples/data/make_ur5_wiping.py

MuJoCo's contact solver makes the contact, with friction in joints and contact that the robot file does not
declare. Positions, velocities and torques have the resolution and noise of sensors; accelerations are not
logged. `table_force` is the normal force that the solver applied, as a load cell under the table shows it.
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import forcegp
from forcegp.simulate import Sensors, simulate

FILE = Path(__file__).resolve().parent / "ur5_wiping.csv"
SENSORS = Sensors(encoder_resolution=2e-5, velocity_noise=5e-4, torque_noise=0.2)
DURATION, PERIOD = 20.0, 0.004
"""Length and sampling period of the log [s]."""


def main() -> None:
    scene = forcegp.load_scene("ur5_wiping")
    motion = dataclasses.replace(scene.simulation, duration=DURATION, dt=PERIOD, sensors=SENSORS)
    data = simulate(scene.system(), motion).data
    joints = range(data.nq)
    heading = [f"{name}_{i}" for name in ("actual_q", "actual_qd", "actual_torque") for i in joints]
    force = data.multiplier["table"] * data.contact["table"]
    with FILE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["timestamp", *heading, "table_force"])
        for k in range(len(data)):
            row = [*data.q[k].tolist(), *data.qd[k].tolist(), *data.tau[k].tolist()]
            writer.writerow([f"{float(data.t[k]):.3f}", *(f"{x:.5f}" for x in row), f"{float(force[k]):.2f}"])
    print(f"{FILE}: {len(data)} rows")


if __name__ == "__main__":
    main()
