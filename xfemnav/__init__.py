"""xfemnav: update preoperative images after cuts and retractions with the extended finite element method."""

from importlib import import_module

__version__ = "0.1.0"

_HOMES = {
    "run": "xfemnav.pipeline.result",
    "Result": "xfemnav.pipeline.result",
    "Session": "xfemnav.pipeline.session",
    "XfemnavError": "xfemnav.errors",
    "XfemnavWarning": "xfemnav.errors",
}
__all__ = ["Result", "Session", "XfemnavError", "XfemnavWarning", "__version__", "run"]


def __getattr__(name: str):
    """Public names, imported when they are first used: `import xfemnav` loads no numerics."""
    if name not in _HOMES:
        raise AttributeError(f"module 'xfemnav' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
