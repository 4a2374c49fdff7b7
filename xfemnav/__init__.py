"""xfemnav: update preoperative images after cuts and retractions with the extended finite element method."""

import lazy_loader

__version__ = "0.1.0"

# The public names stand in __init__.pyi, where type checkers find them too; they are imported when they are first used,
# so that `import xfemnav` loads no numerics.
__getattr__, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]


def __dir__() -> list[str]:
    """The public names."""
    return list(__all__)
