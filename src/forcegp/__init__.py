"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on unknown forces.

The public names listed in `__init__.pyi` are imported on first use. Since `import forcegp` alone does not
load PyTorch, the command line starts quickly.
"""

import functools
import importlib
import warnings
from collections.abc import Callable

__version__ = "0.2.0"

_MOVED = {
    "AnalyticalMean": "priors",
    "AnalyticalParameters": "robot",
    "Baumgarte": "constraints",
    "BristlePrior": "priors",
    "ContactForcePrior": "priors",
    "Cylinder": "constraints",
    "DrivePrior": "priors",
    "Evaluation": "evaluation",
    "ImplicitSurface": "constraints",
    "IndependentGP": "models",
    "InertialPrior": "priors",
    "JointForcePrior": "priors",
    "JointFrictionPrior": "priors",
    "LearningOptions": "models",
    "NeuralNetwork": "models",
    "NormalForcePrior": "priors",
    "Observation": "priors",
    "OffsetPrior": "priors",
    "OperatorForcePrior": "priors",
    "PayloadPrior": "priors",
    "PerRecording": "priors",
    "PointConnection": "constraints",
    "ResidualPrior": "priors",
    "RipplePrior": "priors",
    "Rollout": "rollout",
    "RolloutOptions": "rollout",
    "SavitzkyGolay": "data",
    "SlidingFrictionPrior": "priors",
    "Sphere": "constraints",
    "TaskSpaceControl": "rollout",
    "contact_loss_probability": "rollout",
}
"""Names that were here until 0.2, and the modules that have them."""


@functools.cache
def _public() -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    import lazy_loader

    return lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Return a public name, whose module is imported when it is first used."""
    attached, _, names = _public()
    if name == "__all__":
        return names
    if name not in _MOVED:
        return attached(name)
    home = f"forcegp.{_MOVED[name]}"
    text = f"forcegp.{name} is now {home}.{name}; the old name is removed in 0.4"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return _public()[2]
