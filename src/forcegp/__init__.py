"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on the unknown forces.

Public names, listed in `__init__.pyi`, are imported when they are first used: `import forcegp` alone does not
load PyTorch, so that the command line starts quickly.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
