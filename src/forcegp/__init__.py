"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on the unknown forces.

Public names, listed in `__init__.pyi`, are imported when they are first used: `import forcegp` alone loads no
PyTorch, so that the command line answers at once.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
