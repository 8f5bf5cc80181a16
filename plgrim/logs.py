"""Structured logs: key=value lines for people, JSON where a program reads them (`PLGRIM_LOG_JSON=1`)."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections import Counter
from typing import Any

import structlog


def configure_logs(service: str = "", level: int = logging.INFO) -> None:
    """Write logs to standard error, one line an event, each with its service. Call once a process."""
    as_json = os.environ.get("PLGRIM_LOG_JSON", "") not in ("", "0")
    renderer: Any = (
        structlog.processors.JSONRenderer()
        if as_json
        else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),  # whichever it is now
        cache_logger_on_first_use=False,
    )
    if service:
        structlog.contextvars.bind_contextvars(service=service)


class Seldom:
    """Lets one line of a kind through, and the next after `pause_s`: strangers must not fill the disk with refusals."""

    def __init__(self, pause_s: float = 10.0) -> None:
        self._pause_s = pause_s
        self._due_s: dict[str, float] = {}
        self._since: Counter[str] = Counter()

    def more(self, kind: str) -> int | None:
        """How many of a kind there were since the last line, when it is time for one; else None. Few kinds, please."""
        self._since[kind] += 1
        now = time.monotonic()
        if now < self._due_s.get(kind, 0.0):
            return None
        self._due_s[kind] = now + self._pause_s
        return self._since.pop(kind)


def get_logger() -> Any:
    """The logger (structlog's bound loggers carry no useful static type)."""
    return structlog.get_logger()
