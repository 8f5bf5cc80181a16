"""`plgrim evaluate grid`: third-party occupancy maps under the published rules of ARiADNE and DARE."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from plgrim.commands.options import OutFolder

_INTERRUPTED = 130


class RulesOption(StrEnum):
    """The two protocols."""

    ARIADNE = "ariadne"
    DARE = "dare"


def grid(
    maps: Annotated[
        Path, typer.Option(help="Folder of PNG maps, or of folders named <rules>*, such as ariadne_easy.")
    ],
    rules: Annotated[
        RulesOption, typer.Option(help="Sensor, lattice, end and score: docs in grid_rules.py.")
    ],
    peers: Annotated[
        Path | None,
        typer.Option(help="CSV of the peers' travels; default: peers_<rules>.csv in or beside --maps."),
    ] = None,
    parameters: Annotated[
        Path | None,
        typer.Option(help="YAML of the Explorer; default: the one file for all maps and both rules."),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Maps at once; default: one a core.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only so many maps of each folder.")] = None,
    pictures: Annotated[bool, typer.Option("--pictures", help="A picture of the way on each map.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Drive all maps anew.")] = False,
    out: OutFolder = Path("out/grid"),
) -> None:
    """Explore maps with PLGRIM under a peer's rules, and compare the travel; maps driven before are kept.

    Exit 0 when every map has a row, 1 when one failed, 130 on Ctrl-C; the same command goes on with what is missing.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from plgrim.evaluation.grid_run import PARAMETERS, plan_tasks, run_tasks, write_tables
    from plgrim.runtime.process import stop_on_signals

    console = Console()
    tasks = plan_tasks(maps, rules.value, out, parameters or PARAMETERS, peers, pictures)
    tasks = _first(tasks, limit)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with stop_on_signals() as stop, Progress(*columns, console=console) as progress:
        shown = progress.add_task(f"{rules.value}: maps", total=len(tasks))

        def tell(row: dict[str, Any]) -> None:
            progress.console.print(
                f"{row['set']}/{row['map']}: {row['travel']:.0f}, ratio {row['ratio']:.3f}, {row['moves']} moves"
                f"{'' if row['finished'] else ', NOT FINISHED'}",
                highlight=False,
            )
            progress.advance(shown)

        workers = jobs or len(os.sched_getaffinity(0))
        rows, failed = run_tasks(tasks, workers, tell, stop.is_set, force)
    command = f"plgrim evaluate grid --maps {maps} --rules {rules.value}"
    if rows:
        console.print(
            write_tables(rows, rules.value, out, command), markup=False, highlight=False, soft_wrap=True
        )
    for line in failed:
        console.print(f"failed: {line}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"results in {out}/: maps.csv, summary.md, maps/", highlight=False)
    if len(rows) + len(failed) < len(tasks):
        console.print("interrupted: the same command goes on with what is missing", highlight=False)
        sys.exit(_INTERRUPTED)
    sys.exit(1 if failed else 0)


def _first(tasks: list[Any], limit: int | None) -> list[Any]:
    """The first maps of each folder."""
    counts: dict[str, int] = {}
    kept = []
    for task in tasks:
        counts[task.group] = counts.get(task.group, 0) + 1
        if limit is None or counts[task.group] <= limit:
            kept.append(task)
    return kept


def register(group: typer.Typer) -> None:
    """Add the command of this file to `plgrim evaluate`."""
    group.command("grid")(grid)
