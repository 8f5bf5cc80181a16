"""Compiled kernels: the one `njit` of the project.

numba caches a compiled function by the time stamp of its own file only, so a change in a kernel that another
module calls would leave a stale cache behind. The cache directory is therefore keyed by the content of every
source file that holds a kernel, next to the numba and Python versions.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config

_Function = TypeVar("_Function", bound=Callable[..., Any])
_SOURCE_ROOT = Path(__file__).resolve().parent.parent


def cache_directory() -> Path:
    """Directory of the compiled kernels: `$PLGRIM_CACHE_DIR` or `~/.cache/plgrim`, then a hash of the sources."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for room in ("planning", "services"):
        for path in sorted((_SOURCE_ROOT / room).rglob("*.py")):
            source = path.read_bytes()
            if b"njit" in source or b"overload" in source:
                digest.update(path.relative_to(_SOURCE_ROOT).as_posix().encode() + source)
    base = os.environ.get("PLGRIM_CACHE_DIR") or str(Path.home() / ".cache" / "plgrim")
    return Path(base) / "numba" / digest.hexdigest()[:16]


def _configure() -> None:
    if "NUMBA_CACHE_DIR" not in os.environ:
        numba_config.CACHE_DIR = str(cache_directory())


_configure()


def njit(function: _Function) -> _Function:
    """Compile `function` with the project's settings: cached on disk, without the GIL, IEEE arithmetic.

    `error_model="numpy"` gives inf and nan on division by zero, as numpy does. `fastmath` stays off, so that a
    result does not depend on how the compiler reorders a sum.
    """
    return cast(_Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def njit_borrowing(function: _Function) -> _Function:
    """As `njit`, for inner kernels that make no arrays and keep none: their arguments are borrowed.

    numba counts references of every array of a tuple that a call hands on, with atomic instructions; in kernels that
    hand a model of two dozen arrays to small functions that was most of the time. A function that would have to count
    (one that allocates or slices) is refused at compilation.
    """
    return cast(
        _Function,
        numba.njit(cache=True, nogil=True, error_model="numpy", _nrt=False, forceinline=True)(function),
    )
