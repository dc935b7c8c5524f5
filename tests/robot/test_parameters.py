"""Learnable figures: what is learned, gradients, and that every value is a physical robot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import forcegp
from forcegp import dynamics, kinematics
from forcegp.errors import InertiaError, ModelError, UnknownNameError
from forcegp.robot.parameters import POSITIVE, SMALLEST, AnalyticalParameters
from forcegp.robot.tree import Inertial, inertia_doubt, inertia_error
from robots import random_states

GRADIENT = 1e-6  # relative, against central differences with Richardson's extrapolation
LAST = "lbr_iiwa_joint_7"
EVERYTHING = {
    "inertia": ["lbr_iiwa_joint_3", LAST],
    "mass": ["lbr_iiwa_joint_2"],
    "com": ["lbr_iiwa_joint_2", "lbr_iiwa_joint_5"],
    "offset": ["lbr_iiwa_joint_1", LAST],
    **{name: "all" for name in POSITIVE if name != "mass"},
}


@pytest.fixture(scope="module")
def robot() -> forcegp.RobotModel:
    return forcegp.load_robot("kuka_iiwa")


def test_start_is_the_robot_itself(robot: forcegp.RobotModel) -> None:
    made = AnalyticalParameters(robot, {"inertia": "all", "offset": "all", "damping": "all"})()
    for field in ("mass", "com", "inertia", "placement_rotation", "placement_position", "damping"):
        torch.testing.assert_close(getattr(made, field), getattr(robot, field), rtol=1e-11, atol=1e-13)
    assert made.friction is robot.friction


def test_zero_friction_starts_at_a_small_value(robot: forcegp.RobotModel) -> None:
    made = AnalyticalParameters(robot, {"friction": [LAST]})()
    assert made.friction.tolist() == pytest.approx([0.0] * 6 + [SMALLEST])


def _quantities(robot: forcegp.RobotModel) -> dict[str, Callable[[forcegp.RobotModel], torch.Tensor]]:
    q, qd, qdd, force = random_states(robot, 4, seed=5)
    return {
        "inverse dynamics": lambda r: dynamics.inverse_dynamics(r, q, qd, qdd),
        "forward dynamics": lambda r: dynamics.forward_dynamics(
            r, q, qd, force + dynamics.damping_force(r, qd)
        ),
        "tip": lambda r: kinematics.point_position(r, q, "lbr_iiwa_link_7", (0.0, 0.0, 0.1)),
    }


@pytest.mark.parametrize("what", ["inverse dynamics", "forward dynamics", "tip"])
def test_gradients_match_central_differences(robot: forcegp.RobotModel, what: str) -> None:
    theta = AnalyticalParameters(robot, EVERYTHING)
    theta.reset(torch.Generator().manual_seed(1), relative=0.2, length=0.02, angle=0.1)
    function = _quantities(robot)[what]
    weights = torch.randn(
        function(robot).shape, generator=torch.Generator().manual_seed(2), dtype=robot.dtype
    )

    def value() -> torch.Tensor:
        return (weights * function(theta())).sum()

    value().backward()
    for quantity, x in theta.coordinates.items():
        gradient = torch.zeros_like(x) if x.grad is None else x.grad
        numeric = torch.zeros_like(x)
        for index in np.ndindex(*x.shape):
            numeric[index] = _central_difference(x, index, value)
        size = float(numeric.abs().max())
        assert float((gradient - numeric).abs().max()) <= GRADIENT * max(size, 1e-3), quantity
        assert size > 0 or what != "forward dynamics" or quantity == "stribeck_velocity", quantity


def _central_difference(x: torch.Tensor, index: tuple[int, ...], value: Callable[[], torch.Tensor]) -> float:
    """Central difference of fourth order, (8 (f₁ − f₋₁) − (f₂ − f₋₂)) / 12 h."""
    start, h, total = x.data[index].item(), 2e-4, 0.0
    with torch.no_grad():
        for step, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
            x.data[index] = start + step * h
            total += weight * value().item()
    x.data[index] = start
    return total / (12.0 * h)


def test_random_start_is_physical_reproducible_and_within_its_window(robot: forcegp.RobotModel) -> None:
    theta = AnalyticalParameters(robot, EVERYTHING)
    for seed in range(20):
        theta.reset(torch.Generator().manual_seed(seed), relative=1.0, length=0.05, angle=0.3)
        made = theta()
        for m, c, I in zip(made.mass, made.com, made.inertia, strict=True):
            figures = m.item(), c.detach().numpy(), I.detach().numpy()
            assert inertia_error(Inertial(*figures)) == inertia_doubt(Inertial(*figures)) == ""
        R = made.placement_rotation.detach()
        torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), rtol=0, atol=1e-12)
        assert 1 / np.e < made.mass[1].item() / robot.mass[1].item() < np.e
        assert float((made.com[4].detach() - robot.com[4]).abs().max()) < 0.05
    again = AnalyticalParameters(robot, EVERYTHING)
    again.reset(torch.Generator().manual_seed(19), relative=1.0, length=0.05, angle=0.3)
    assert again().fingerprint == theta().fingerprint != robot.fingerprint


def test_offset_of_the_last_joint_moves_its_frame_only(robot: forcegp.RobotModel) -> None:
    theta = AnalyticalParameters(robot, {"offset": [LAST]})
    with torch.no_grad():
        theta.coordinates["offset"][0] = torch.tensor([0.0, 0.0, 0.3, 0.01, 0.02, 0.03])
    q = random_states(robot, 1)[0]
    pose = kinematics.frame_pose(theta(), q, "lbr_iiwa_link_7")
    old = kinematics.frame_pose(robot, q, "lbr_iiwa_link_7")
    assert (pose[1] - old[1]).norm(dim=-1).item() == pytest.approx(np.linalg.norm([0.01, 0.02, 0.03]))
    before = [kinematics.frame_pose(r, q, "lbr_iiwa_link_6")[1] for r in (robot, theta())]
    assert torch.equal(*before)


def test_state_dict_survives_a_file(robot: forcegp.RobotModel, tmp_path: Path) -> None:
    theta = AnalyticalParameters(robot, EVERYTHING)
    theta.reset(torch.Generator().manual_seed(3), relative=0.5, length=0.03, angle=0.2)
    assert set(theta.state_dict()) == {f"coordinates.{name}" for name in EVERYTHING}
    save_file(theta.state_dict(), tmp_path / "theta.safetensors")
    other = AnalyticalParameters(robot, EVERYTHING)
    other.load_state_dict(load_file(tmp_path / "theta.safetensors"))
    assert other().fingerprint == theta().fingerprint


def test_learning_recovers_the_mass_and_offset_it_started_from(robot: forcegp.RobotModel) -> None:
    q, qd, qdd, _ = random_states(robot, 50, seed=7)
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd)
    theta = AnalyticalParameters(robot, {"mass": [LAST], "offset": [LAST]})
    theta.reset(torch.Generator().manual_seed(0), relative=0.5, length=0.03, angle=0.1)
    optimizer = torch.optim.LBFGS(
        theta.parameters(), max_iter=80, tolerance_grad=1e-12, tolerance_change=1e-15,
        line_search_fn="strong_wolfe",
    )  # fmt: skip

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        error = ((dynamics.inverse_dynamics(theta(), q, qd, qdd) - tau) ** 2).mean()
        error.backward()
        return error

    optimizer.step(loss)
    assert theta().mass[-1].item() == pytest.approx(robot.mass[-1].item(), rel=1e-3)
    # The turn about the last axis and nothing else is lost in a redefinition of q7 and of the link axes.
    shift = theta.coordinates["offset"][0, 3:]
    assert shift.abs().max().item() < 1e-3


def test_wrong_requests_are_refused(robot: forcegp.RobotModel) -> None:
    with pytest.raises(
        UnknownNameError, match=r"unknown quantity to learn 'masses'(.|\n)*did you mean 'mass'"
    ):
        AnalyticalParameters(robot, {"masses": "all"})
    with pytest.raises(UnknownNameError, match="unknown joint of robot 'kuka_iiwa' 'joint_7'"):
        AnalyticalParameters(robot, {"mass": ["joint_7"]})
    with pytest.raises(ModelError, match="no analytical parameter"):
        AnalyticalParameters(robot, {"mass": []})
    with pytest.raises(ModelError, match=f"mass and inertia of the link of joint '{LAST}' are both"):
        AnalyticalParameters(robot, {"mass": "all", "inertia": [LAST]})
    flat = robot.replace(inertia=robot.inertia * torch.tensor([1.0, 1.0, 9.0], dtype=robot.dtype).diag())
    with pytest.raises(
        InertiaError, match=r"link of joint 'lbr_iiwa_joint_2' is not physical(.|\n)*mass or com alone"
    ):
        AnalyticalParameters(flat, {"inertia": "all"})
    massless = robot.replace(mass=torch.zeros_like(robot.mass))
    with pytest.raises(InertiaError, match="'lbr_iiwa_joint_1' has no mass to learn"):
        AnalyticalParameters(massless, {"mass": "all"})


def test_torch_func_differentiates_through_the_robot(robot: forcegp.RobotModel) -> None:
    """jacrev over the coordinates equals the regressor's columns, scaled by the mass for its logarithm."""
    q, qd, qdd, _ = random_states(robot, 3)
    theta = AnalyticalParameters(robot, {"mass": [LAST], "damping": "all"})

    def tau(coordinates: dict[str, torch.Tensor]) -> torch.Tensor:
        made = torch.func.functional_call(theta, coordinates)
        return dynamics.inverse_dynamics(made, q, qd, qdd) - dynamics.damping_force(made, qd)

    jacobian = torch.func.jacrev(tau)(dict(theta.named_parameters()))
    expected = torch.diag_embed(robot.damping * qd)
    torch.testing.assert_close(jacobian["coordinates.damping"], expected, rtol=1e-12, atol=1e-12)
    without = robot.replace(mass=robot.mass * torch.tensor([1.0] * 6 + [0.0], dtype=robot.dtype))
    difference = [dynamics.inverse_dynamics(r, q, qd, qdd) for r in (robot, without)]
    torch.testing.assert_close(
        jacobian["coordinates.mass"][..., 0], difference[0] - difference[1], rtol=1e-10, atol=1e-10
    )
