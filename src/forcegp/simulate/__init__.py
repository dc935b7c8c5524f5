"""Simulation of a robot, in free motion or in contact, with a physics engine."""

from forcegp.control.task_space import Gains
from forcegp.control.trajectory import Reference
from forcegp.simulate.config import ContactSolver, Sensors, SimulationConfig
from forcegp.simulate.engine import Engine, EngineCheck, check_engine
from forcegp.simulate.engines import make_engine
from forcegp.simulate.result import SimulationResult
from forcegp.simulate.run import simulate

__all__ = [
    "ContactSolver",
    "Engine",
    "EngineCheck",
    "Gains",
    "Reference",
    "Sensors",
    "SimulationConfig",
    "SimulationResult",
    "check_engine",
    "make_engine",
    "simulate",
]
