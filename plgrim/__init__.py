"""PLGRIM: hierarchical value learning for exploration. As a library: `from plgrim import Explorer, Grid`."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plgrim.explorer import Cloud, Explorer, ExplorerConfig, Grid, Plan, Pose

__all__ = ["Cloud", "Explorer", "ExplorerConfig", "Grid", "Plan", "Pose"]


def __getattr__(name: str) -> Any:
    """Loaded when asked for: the command line does not wait for the planners."""
    if name in __all__:
        return getattr(importlib.import_module("plgrim.explorer"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
