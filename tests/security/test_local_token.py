"""The token that a run makes for its owner: on his terminal and in his files, in no log."""

from __future__ import annotations

import io
import os
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest
from rich.console import Console

from plgrim.config import Config
from plgrim.missions import run_live
from plgrim.security.local_token import PAGE_FILE, TOKEN_FILE, page_to_print, with_local_token
from schemas.topics import SERVICES
from tests.runtime.helpers import fake_command
from tests.security.helpers import free_port

PAGE = "http://127.0.0.1:8080/"


@pytest.fixture
def terminal() -> Iterator[TextIO]:
    """A real one."""
    ours, theirs = os.openpty()
    with os.fdopen(ours, "rb"), os.fdopen(theirs, "w") as out:
        yield out


def _secret(folder: Path) -> str:
    return (folder / TOKEN_FILE).read_text(encoding="utf-8").split()[2]


def _mode(file: Path) -> int:
    return stat.S_IMODE(file.stat().st_mode)


def test_a_terminal_gets_the_token_and_nothing_else_does(tmp_path: Path, terminal: TextIO) -> None:
    config = with_local_token(Config(), tmp_path)
    secret = _secret(tmp_path)
    assert page_to_print(PAGE, config, tmp_path, terminal) == f"{PAGE}#token={secret}"
    (tmp_path / PAGE_FILE).chmod(0o644)  # of a run of an older version, say
    printed = page_to_print(PAGE, config, tmp_path, io.StringIO())
    assert secret not in printed and PAGE in printed and str(tmp_path / PAGE_FILE) in printed
    assert (tmp_path / PAGE_FILE).read_text(encoding="utf-8") == f"{PAGE}#token={secret}\n"
    assert (_mode(tmp_path / PAGE_FILE), _mode(tmp_path / TOKEN_FILE)) == (0o600, 0o600)


def test_tokens_of_the_configuration_are_never_printed(tmp_path: Path, terminal: TextIO) -> None:
    (tmp_path / "tokens").write_text("operator anna a-secret-of-anna\n", encoding="utf-8")
    config = Config.model_validate({"status": {"tokens_file": str(tmp_path / "tokens")}})
    assert page_to_print(PAGE, with_local_token(config, tmp_path), tmp_path, terminal) == PAGE
    assert not (tmp_path / PAGE_FILE).exists()


def test_a_page_file_that_leads_elsewhere_is_not_written(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").touch()
    (tmp_path / PAGE_FILE).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic"):
        page_to_print(PAGE, with_local_token(Config(), tmp_path), tmp_path, io.StringIO())
    assert (tmp_path / "elsewhere").read_bytes() == b""


@pytest.mark.parametrize("services", [SERVICES, ("gcp",)])
def test_what_a_run_prints_and_logs_holds_no_token(services: tuple[str, ...], tmp_path: Path) -> None:
    """Also with colours, which are no sign of a terminal: CI asks for them."""
    said, stop = io.StringIO(), threading.Event()
    stop.set()
    config = Config.model_validate({"router": {"endpoint": f"tcp/127.0.0.1:{free_port()}"}})
    run_live(
        config, tmp_path, stop, Console(file=said, force_terminal=True), True, services, fake_command({})
    )
    secret = _secret(tmp_path)
    assert (PAGE_FILE in said.getvalue()) == ("status" in services)
    logs = [said.getvalue(), *(file.read_text(encoding="utf-8") for file in (tmp_path / "logs").iterdir())]
    assert not [log for log in logs if secret in log]
