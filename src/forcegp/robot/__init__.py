"""The frozen robot model and its readers."""

from forcegp.robot.load import load_robot
from forcegp.robot.model import RobotModel

__all__ = ["RobotModel", "load_robot"]
