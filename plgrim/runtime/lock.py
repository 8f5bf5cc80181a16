"""A lock on a file, held by one process at a time, and let go by the kernel when that process dies."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

from plgrim.errors import AlreadyRunningError


class Lock:
    """A lock on a file that lives as long as this process, held by one at a time."""

    def __init__(self, path: Path, what: str, mend: str) -> None:
        """what, mend: for the text of AlreadyRunningError, which is raised when another process holds it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.pread(self._descriptor, 32, 0).decode("ascii", "replace").strip()
            self.close()
            raise AlreadyRunningError(f"{path}: {what} (process {holder or 'unknown'}): {mend}") from error
        with contextlib.suppress(OSError):  # a full disk: the lock holds, only its name is missing
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, str(os.getpid()).encode(), 0)

    def close(self) -> None:
        """Let it go. The file stays: removing it would let two hold it."""
        os.close(self._descriptor)
