"""The frozen robot model, its readers, and its learnable parameters."""

from forcegp.robot.load import load_robot
from forcegp.robot.model import RobotModel
from forcegp.robot.parameters import AnalyticalParameters

__all__ = ["AnalyticalParameters", "RobotModel", "load_robot"]
