"""Missions of a campaign on a Dask cluster: `--dask ADDRESS`, for those who outgrow one machine.

Workers need this version of plgrim and nothing else: no shared disk. A mission's folder is sent as bytes, and comes
back as bytes. Each runs in a child process of its worker, as it would here.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from plgrim.errors import ConfigError
from plgrim.evaluation.campaign_child import LOG_FILE
from plgrim.evaluation.campaign_pool import Command, child_command, mission_environment

_POLL_S = 0.5
_ASK_EVERY_S = 2.0
_GRACE_S = 3.0

Files = dict[str, bytes]


def read_folder(folder: Path) -> Files:
    """The files of a run's folder by name; it has no folders in it."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def write_folder(folder: Path, files: Files) -> None:
    """Write files into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / Path(name).name).write_bytes(content)


def run_files(files: Files, command: Command, stopped: Callable[[], bool]) -> tuple[int, Files]:
    """Run a mission that is given as the files of its folder; its exit code, and the files afterwards.

    stopped: asked now and then; when true, the child is ended and its code is that of the signal.
    """
    with tempfile.TemporaryDirectory(prefix="plgrim-mission-") as name:
        folder = Path(name)
        write_folder(folder, files)
        with (folder / LOG_FILE).open("wb") as log:
            child = subprocess.Popen(
                command(folder),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=mission_environment(os.environ),
            )
        asked_s = time.monotonic()
        while child.poll() is None:
            time.sleep(_POLL_S)
            if time.monotonic() - asked_s >= _ASK_EVERY_S:
                asked_s = time.monotonic()
                if stopped():
                    _end(child)
        return child.returncode, read_folder(folder)


def _end(child: subprocess.Popen[bytes]) -> None:
    child.terminate()
    try:
        child.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _on_worker(files: Files, command: Command, stop_name: str) -> tuple[int, Files]:
    """What a worker does: the mission, until the campaign is stopped."""
    from distributed import Event

    stop = Event(stop_name)
    return run_files(files, command, stop.is_set)


class DaskPool:
    """Runs the missions of a campaign on the cluster whose scheduler has this address."""

    def __init__(self, address: str, command: Command = child_command) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise ConfigError("--dask needs the extra: pip install 'plgrim[dask]'") from error
        self._command = command
        self._folders: list[Path] = []
        try:
            self._client: Any = Client(address, timeout="10s", set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise ConfigError(f"--dask {address}: no scheduler answers there: {error}") from error

    @property
    def folders(self) -> list[Path]:
        """Of the missions that the cluster has been given and has not ended."""
        return list(self._folders)

    def run(
        self,
        folders: Sequence[Path],
        stop: threading.Event,
        ended: Callable[[Path, int], None],
        poll: Callable[[], None] = lambda: None,
    ) -> None:
        """Until all have ended or `stop`; as `campaign_pool.Pool.run`."""
        from distributed import Event

        waiting, futures = deque(folders), dict[Any, Path]()
        halt = Event(f"plgrim-stop-{uuid.uuid4().hex}", client=self._client)
        try:
            while (waiting or futures) and not stop.is_set():
                while waiting and len(futures) < self._slots():
                    folder = waiting.popleft()
                    futures[self._submit(folder, halt.name)] = folder
                self._take_results(futures, ended)
                self._folders = list(futures.values())
                poll()
                stop.wait(_POLL_S)
        finally:
            halt.set()
            self._client.cancel(list(futures), force=True)
            self._folders = []

    def _slots(self) -> int:
        """One mission a thread of the workers, and one that waits there."""
        threads: dict[str, int] = self._client.nthreads()
        return sum(threads.values()) + 1

    def _submit(self, folder: Path, stop_name: str) -> Any:
        return self._client.submit(
            _on_worker, read_folder(folder), self._command, stop_name, pure=False, retries=1
        )

    def _take_results(self, futures: dict[Any, Path], ended: Callable[[Path, int], None]) -> None:
        for future in [future for future in futures if future.done()]:
            folder = futures.pop(future)
            code, files = self._result(future)
            write_folder(folder, files)
            ended(folder, code)

    @staticmethod
    def _result(future: Any) -> tuple[int, Files]:
        """A worker that is lost, or cannot run missions at all, is a mission that crashed: its log says why."""
        if future.status != "finished":
            return 1, {LOG_FILE: f"on the cluster: {future.exception()!r}\n".encode()}
        code, files = future.result()
        return code, files

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()
