"""θ_A of the identification: mass of the last link and position of the last joint."""

from __future__ import annotations

import torch
from torch import nn

from forcegp.robot.model import RobotModel

WRONG_MASS = 2.5
"""Initial mass of the last link [kg]; the truth is 2.0."""
WRONG_OFFSET = 0.05
"""Initial error of the last joint's position along each axis [m]."""


class LastLink(nn.Module):
    """θ_A = (log mass of the last link, shift of the last joint).

    The shift is learned in centimetres, so that the optimiser's steps are small changes of posture.
    """

    def __init__(self, start: RobotModel) -> None:
        super().__init__()
        self.start = start
        self.log_mass = nn.Parameter(start.mass[-1].log())
        self.shift_cm = nn.Parameter(start.placement_position.new_zeros(3))

    def forward(self) -> RobotModel:
        position = self.start.placement_position[-1] + 0.01 * self.shift_cm
        last = torch.tensor([self.start.nq - 1])
        return self.start.replace(
            mass=self.start.mass.index_copy(0, last, self.log_mass.exp()[None]),
            placement_position=self.start.placement_position.index_copy(0, last, position[None]),
        )


def wrong_parameters(robot: RobotModel) -> LastLink:
    """θ_A of a robot whose last link is too heavy and whose last joint is misplaced."""
    mass, position = robot.mass.clone(), robot.placement_position.clone()
    mass[-1] = WRONG_MASS
    position[-1] += WRONG_OFFSET
    return LastLink(robot.replace(mass=mass, placement_position=position))
