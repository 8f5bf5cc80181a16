"""A token for whoever starts a mission on this host, so that the page can steer it and nobody else can."""

from __future__ import annotations

import os
import secrets
from pathlib import Path
from typing import IO

from plgrim.config import Config
from schemas.hosts import is_loopback

TOKEN_FILE = "operator.token"
"""In the run's folder, readable by its owner alone: one line of `status.tokens_file`."""
PAGE_FILE = "page.url"
"""In the run's folder, readable by its owner alone: the page's address with the token."""
_NAME = "local"
_SECRET_BYTES = 24


def with_local_token(config: Config, run_folder: Path) -> Config:
    """The configuration with an operator's token of its own, in the run's folder.

    Unchanged where the configuration names tokens, and where the page listens to other hosts: whoever opens it to them
    says who may command.
    """
    host = str(config.status.get("host", "127.0.0.1"))
    if config.status.get("tokens_file") or not is_loopback(host):
        return config
    file = (run_folder / TOKEN_FILE).resolve()
    if not file.exists():
        run_folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as out:
            out.write(f"operator {_NAME} {secrets.token_urlsafe(_SECRET_BYTES)}\n")
    return config.model_copy(update={"status": {**config.status, "tokens_file": str(file)}})


def page_to_print(page: str, config: Config, run_folder: Path, out: IO[str]) -> str:
    """The page's address as it may be printed to `out`; with the token it also goes into PAGE_FILE.

    A terminal gets the token. What is no terminal is kept and read by others (systemd's journal, logs of containers and
    of CI): it gets the file's name instead.
    """
    fragment = page_fragment(config)
    if not fragment:
        return page
    file = run_folder / PAGE_FILE
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW
    with os.fdopen(os.open(file, flags, 0o600), "w", encoding="utf-8") as writing:
        os.fchmod(writing.fileno(), 0o600)
        writing.write(f"{page}{fragment}\n")
    return page + fragment if out.isatty() else f"{page} (with an operator's token: see {file})"


def page_fragment(config: Config) -> str:
    """`#token=...` for the page's address, where the token is that of `with_local_token`; else empty.

    What follows a # stays in the browser: it is in no request and in no log of a server.
    """
    file = Path(str(config.status.get("tokens_file") or ""))
    if file.name != TOKEN_FILE:
        return ""
    role, name, secret = file.read_text(encoding="utf-8").split()
    return f"#token={secret}" if (role, name) == ("operator", _NAME) else ""
