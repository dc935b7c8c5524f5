"""Simulation of a robot that follows a motion, free or in contact, in a physics engine."""

from forcegp.simulate.check import EngineCheck, check_engine
from forcegp.simulate.config import SimulationConfig
from forcegp.simulate.control import Gains
from forcegp.simulate.engine import Engine, make_engine
from forcegp.simulate.result import SimulationResult
from forcegp.simulate.run import simulate
from forcegp.simulate.trajectory import Reference

__all__ = [
    "Engine",
    "EngineCheck",
    "Gains",
    "Reference",
    "SimulationConfig",
    "SimulationResult",
    "check_engine",
    "make_engine",
    "simulate",
]
