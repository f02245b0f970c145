"""Align colour with sparse depth and complete the depth, with one small network."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from depthreg.model import Model, load
    from depthreg.result import PointCloud, Result

__version__ = "0.1.0"
__all__ = ["Model", "PointCloud", "Result", "load"]


def __getattr__(name: str) -> Any:
    """Import PyTorch and the rest when the first of `__all__` is asked for: `depthreg --help` takes no seconds."""
    if name not in __all__:
        raise AttributeError(f"module 'depthreg' has no attribute '{name}'")
    from importlib import import_module

    home = "depthreg.model" if name in ("Model", "load") else "depthreg.result"
    return getattr(import_module(home), name)
