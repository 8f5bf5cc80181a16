"""What the tests of the runtime share."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
FAKES = Path(__file__).with_name("fake_services.py")
Start = Callable[..., subprocess.Popen[str]]


def eventually(
    condition: Callable[[], object],
    what: str,
    doing: Callable[[], object] = lambda: None,
    within_s: float = 30.0,
) -> None:
    """Wait until a condition holds, `doing` something meanwhile; the limit only keeps a broken test from hanging."""
    deadline = time.monotonic() + within_s
    doing()
    while not condition():
        assert time.monotonic() < deadline, f"never happened: {what}"
        time.sleep(0.02)
        doing()


def fake_command(behaviours: dict[str, str]) -> Callable[[str], list[str]]:
    """Command lines of fakes, for the supervisor."""

    def command(service: str) -> list[str]:
        return [sys.executable, str(FAKES), service, behaviours.get(service, "")]

    return command
