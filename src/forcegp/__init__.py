"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on the unknown forces."""

from forcegp import dynamics, kinematics
from forcegp.robot import RobotModel, load_robot

__all__ = ["RobotModel", "dynamics", "kinematics", "load_robot"]
