"""Rasters of user files on disk, by the content of the file: made once, read by every process after."""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[np.generic]]


def cache_directory() -> Path:
    """`$PLGRIM_CACHE_DIR` or `~/.cache/plgrim`, then `worlds`."""
    base = os.environ.get("PLGRIM_CACHE_DIR") or str(Path.home() / ".cache" / "plgrim")
    return Path(base) / "worlds"


def cached(content: bytes, recipe: str, make: Callable[[], Arrays]) -> Arrays:
    """The arrays that `make` gives for this content and recipe, from the cache if they are there.

    A cache that cannot be read is made anew, one that cannot be written is done without.
    """
    key = hashlib.sha256(recipe.encode() + b"\0" + content).hexdigest()[:32]
    path = cache_directory() / f"{key}.npz"
    unreadable = (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile)
    with suppress(*unreadable), path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}
    arrays = make()
    with suppress(OSError):
        _write(path, arrays)
    return arrays


def _write(path: Path, arrays: Arrays) -> None:
    """All at once: another process never reads half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        os.replace(name, path)
    except OSError:
        Path(name).unlink(missing_ok=True)
        raise
