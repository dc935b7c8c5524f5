"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on unknown forces.

The public names listed in `__init__.pyi` are imported on first use. Since `import forcegp` alone does not
load PyTorch, the command line starts quickly.
"""

import lazy_loader

__version__ = "0.2.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
