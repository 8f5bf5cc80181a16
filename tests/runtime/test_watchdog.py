"""Services that no supervisor watches: what they tell systemd, and that one that hangs ends itself."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runtime.helpers import FAKES, Start, eventually


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Where a service tells systemd how it is."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(str(tmp_path / "notify"))
        ear.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield ear


def told(ear: socket.socket) -> list[str]:
    """What came since the last look, oldest first."""
    found = []
    while True:
        try:
            found.append(ear.recv(4096).decode("ascii"))
        except BlockingIOError:
            return found


@pytest.mark.parametrize("behaviour", ["loops", "locks"])
@pytest.mark.usefixtures("router")
def test_what_hangs_is_silent_and_ends_itself(
    behaviour: str, systemd: socket.socket, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that holds Python's lock: nothing of Python can run in it any more."""
    monkeypatch.setenv("PLGRIM_RUNTIME__WATCHDOG", "true")
    monkeypatch.setenv("PLGRIM_RUNTIME__STUCK_AFTER_S", "2")
    process = start(str(FAKES), "mission", behaviour)
    said, _ = process.communicate(timeout=120.0)
    assert process.returncode == 1
    assert "Timeout" in said and "in step" in said, said  # where it hung
    heard = told(systemd)
    assert heard[0] == "READY=1\nWATCHDOG=1" and "STOPPING=1" not in heard
    assert 10 < len(heard) < 80  # ten a second: four seconds of steps, half a second until it is late


@pytest.mark.usefixtures("router")
def test_what_steps_says_so_and_ends_when_it_is_told(
    systemd: socket.socket, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLGRIM_RUNTIME__WATCHDOG", "true")
    monkeypatch.setenv("PLGRIM_RUNTIME__STUCK_AFTER_S", "2")
    heard: list[str] = []

    def said_often() -> bool:
        heard.extend(told(systemd))
        return heard.count("WATCHDOG=1") > 50  # over five seconds

    process = start(str(FAKES), "mission", "idle")
    eventually(lambda: told(systemd), "it is ready", within_s=120.0)
    eventually(said_often, "it says that it steps", within_s=60.0)
    assert process.poll() is None
    process.terminate()
    process.communicate(timeout=20.0)
    assert process.returncode == 0
    assert told(systemd)[-1] == "STOPPING=1"
