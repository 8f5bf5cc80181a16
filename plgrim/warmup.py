"""Compiles all kernels once, so that every process later loads them from the disk: `python -m plgrim.warmup`.

Each stage module compiles its own kernels in its `warm_up()`, if it has one.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable

from plgrim.registry import STAGES


def warm_ups() -> dict[str, Callable[[], None]]:
    """The `warm_up` of each stage that has one. A stage that does not import is an error, not skipped."""
    found: dict[str, Callable[[], None]] = {}
    for name in STAGES:
        try:
            module = importlib.import_module(f"services.{name}.stage")
        except ModuleNotFoundError as error:
            if error.name and error.name.startswith(f"services.{name}"):
                continue
            raise
        if hasattr(module, "warm_up"):
            found[name] = module.warm_up
    return found


def warm_up_all() -> dict[str, float]:
    """Compile everything, with a progress display; wall seconds by stage."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    seconds: dict[str, float] = {}
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("kernels: loading", total=None)
        work = warm_ups()
        progress.update(task, total=len(work))
        for name, warm_up in work.items():
            progress.update(task, description=f"kernels: {name}")
            began = time.monotonic()
            warm_up()
            seconds[name] = time.monotonic() - began
            progress.advance(task)
        progress.update(task, description="kernels: ready")
    return seconds


def main() -> None:
    """Entry point; a line a stage for logs."""
    for name, seconds in warm_up_all().items():
        print(f"kernels: {name} {seconds:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
