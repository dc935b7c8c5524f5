"""A real robot: learn the joint friction of a KUKA iiwa14 from its log, beside its robot file.

    python examples/real_iiwa_friction.py [figure.png]

The log is a part of a published one (examples/data/README.md): seven segments train the default model, three
others test it. On a measured log, `StructuredGP(system, "analytical")` has a prior on the friction of each
joint, and learns the noise of the torque sensors. Printed by joint: the error as a torque,
M(q) (q̈_predicted − q̈_measured), with the robot file alone and with the model, and the share of samples whose
error is within ±2σ of the prediction.
"""

# %%
from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

import forcegp
from forcegp import dynamics

LOG = Path(__file__).resolve().parent / "data" / "iiwa14_motion.parquet"
TRAINING_SEGMENTS = 7
IN_MOTION = 0.01
"""A sample is in motion where a joint moves faster [rad/s]."""


def as_torque(robot: forcegp.RobotModel, data: forcegp.Dataset, qdd: Tensor) -> Tensor:
    """M(q) (q̈ − q̈_measured), `(n, nq)` [N m]."""
    return (dynamics.mass_matrix(robot, data.q) @ (qdd - data.qdd)[..., None])[..., 0]


def main() -> None:
    robot = forcegp.load_robot("kuka_iiwa14")
    system = forcegp.ConstrainedSystem(robot)
    data = forcegp.Dataset.read(LOG)
    train, test = data[data.segment < TRAINING_SEGMENTS], data[data.segment >= TRAINING_SEGMENTS]
    test = test[test.qd.abs().amax(-1) > IN_MOTION]

    fit = forcegp.StructuredGP(system, "analytical").fit(train)
    predicted = fit.predict(test.q, test.qd, test.tau, noise=True)
    assert predicted.covariance is not None
    M = dynamics.mass_matrix(fit.system.robot, test.q)
    left = as_torque(fit.system.robot, test, predicted.mean)
    std = (M @ predicted.covariance @ M.mT).diagonal(dim1=-2, dim2=-1).sqrt()

    from_file = forcegp.AnalyticalModel(system).nominal().predict(test.q, test.qd, test.tau).mean
    before = as_torque(robot, test, from_file).square().mean(0).sqrt()
    after = left.square().mean(0).sqrt()
    covered = (left.abs() <= 2.0 * std).to(left.dtype).mean(0)
    print(f"{len(train)} samples train, {len(test)} samples in motion test")
    print("joint           file [N m]   model [N m]   within 2 sigma")
    for name, *values in zip(robot.joint_names, before, after, covered, strict=True):
        file, model, share = (float(value) for value in values)
        print(f"{name:15} {file:10.3f} {model:13.3f} {share:15.0%}")
    ratio = float((after / before).log().mean().exp())
    figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "real_iiwa_friction.png")
    fit.plot(data[data.segment == TRAINING_SEGMENTS], noise=True)[0].figure.savefig(figure, dpi=150)
    print(
        f"torque error, model / robot file: {ratio:.2f} (geometric mean), {float(covered.mean()):.0%} covered"
    )
    print(f"figure: {figure}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
