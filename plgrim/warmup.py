"""Compiles all kernels once, so that every process later loads them from the disk: `python -m plgrim.warmup`.

Each stage module compiles its own kernels in its `warm_up()`, if it has one. Then a rehearsal, the first seconds of a
mission in lock-step, compiles what those have forgotten, with the types that a mission really uses.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import time
from collections.abc import Callable

from plgrim.registry import STAGES
from schemas.contract import SECOND_NS

REHEARSAL_S = 6.0
"""Mission time after which every stage has done all that it does."""


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


def rehearse(mission_s: float = REHEARSAL_S) -> None:
    """Run the first seconds of a mission in lock-step, without a result."""
    from plgrim.runtime.lockstep import Lockstep

    try:
        Lockstep({"sim": {"world": "maze"}}, seed=1).run_until(int(mission_s * SECOND_NS))
    except (
        Exception
    ) as error:  # what compiles late only costs time: the mission itself will say what is wrong
        print(f"kernels: the rehearsal failed: {type(error).__name__}: {str(error)[:300]}", file=sys.stderr)


def warm_up_all() -> dict[str, float]:
    """Compile everything, with a progress display; wall seconds by stage."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    seconds: dict[str, float] = {}
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("kernels: loading", total=None)
        work = warm_ups()
        if importlib.util.find_spec("services.sim.stage") is not None:
            work["rehearsal"] = rehearse
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
