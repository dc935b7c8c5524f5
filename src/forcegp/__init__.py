"""Forward dynamics of robot arms, free or in contact, with Gaussian-process priors on unknown forces.

The public names listed in `__init__.pyi` are imported on first use. Since `import forcegp` alone does not
load PyTorch, the command line starts quickly.
"""

__version__ = "0.2.0"


def __getattr__(name: str) -> object:
    """Attach the public names when the first of them is used."""
    import lazy_loader

    attached = lazy_loader.attach_stub(__name__, __file__)
    globals().update(zip(("__getattr__", "__dir__", "__all__"), attached, strict=True))
    return attached[2] if name == "__all__" else attached[0](name)


def __dir__() -> object:
    return __getattr__("__all__")
