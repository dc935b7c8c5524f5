"""The settings of a simulation: those of the motion, and of the world that the robot moves in."""

from __future__ import annotations

from dataclasses import dataclass

from forcegp.control.motion import MotionConfig


@dataclass(frozen=True)
class SimulationConfig(MotionConfig):
    """What is simulated; the defaults are the paper's task on the bundled arm.

    The settings of the motion (`MotionConfig`) come first; these are added:

    Args:
        seed: of the waypoints, the postures and the noise.
        engine: `"pybullet"`, `"mujoco"` or `"auto"`.
        viscous_friction: θ_v of F_z = −θ_v ṗ_E, tangential to the surface [N s/m].
        noise_std: standard deviation of the noise on q̈ [rad/s²].

    Raises:
        ForceGPError: a value is out of range; the message names it.
    """

    seed: int = 0
    engine: str = "auto"
    viscous_friction: float = 1.0
    noise_std: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_not_negative("viscous_friction", "noise_std")
