"""`plgrim evaluate missions`: campaigns of whole missions."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from plgrim.commands.options import ConfigFile, OutFolder, Robot, put
from plgrim.errors import ConfigError

_INTERRUPTED = 130

Jobs = Annotated[int | None, typer.Option(min=1, help="Missions at once; default: one a core.")]
Dask = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Run on the Dask cluster with this scheduler instead.")
]
Force = Annotated[bool, typer.Option("--force", help="Make runs of other code or configuration anew.")]


def missions(
    world: Annotated[list[str] | None, typer.Option(help="Built-in world; again for more.")] = None,
    map_file: Annotated[
        list[Path] | None, typer.Option("--map", help="ROS map_server YAML file; again for more.")
    ] = None,
    mesh: Annotated[
        list[Path] | None, typer.Option(help="Mesh (OBJ, STL, PLY, DAE); again for more.")
    ] = None,
    dem: Annotated[list[Path] | None, typer.Option(help="Height image; again for more.")] = None,
    seeds: Annotated[str, typer.Option(help="Such as 1-10 or 1,3,5.")] = "1-3",
    variant: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=FILE]",
            help="Built in (default, paper, its single differences, risk_neutral, risk_blind), or a YAML file "
            "that is laid over the configuration; again for more: all are compared with the first, in pairs of "
            "the same world and seed.",
        ),
    ] = None,
    start: Annotated[
        tuple[float, float] | None, typer.Option(metavar="X Y", help="Start in the map's frame, m.")
    ] = None,
    robot: Robot = None,
    time_limit: Annotated[
        float, typer.Option(min=0, help="Mission time after which a mission is stopped, s. 0: none.")
    ] = 0.0,
    jobs: Jobs = None,
    dask: Dask = None,
    force: Force = False,
    out: OutFolder = Path("out/missions"),
    config_file: ConfigFile = None,
) -> None:
    """Run whole missions in lock-step, worlds x variants x seeds, and compare them; finished runs are kept.

    A lost robot is a row, not an error. Exit 0 when every run has a result, 1 when one crashed, 130 on Ctrl-C.
    """
    from plgrim.evaluation.campaign_plan import Campaign, Variant, World, parse_seeds

    worlds = [World.built_in(name) for name in world or []]
    for key, files in (("map_file", map_file), ("mesh_file", mesh), ("dem_file", dem)):
        worlds += [World.file(key, path) for path in files or []]
    if not worlds:
        raise ConfigError("no world: give --world, --map, --mesh or --dem")
    if start is not None and len(worlds) > 1:
        raise ConfigError("--start is a place in one world, but several are given")
    common: dict[str, Any] = {}
    put(common, "profile", robot)
    put(common, "sim.start", None if start is None else {"x_m": start[0], "y_m": start[1]})
    variants = [Variant.parse(text) for text in variant or ["default"]]
    campaign = Campaign(worlds, variants, parse_seeds(seeds), time_limit, config_file, common)
    drive(campaign, out, jobs, dask, force)


def drive(
    campaign: Any,
    out: Path,
    jobs: int | None,
    dask: str | None,
    force: bool,
    report: Callable[[Any], str] = lambda outcome: "summary.md, runs.csv, coverage.png, runs/",
) -> None:
    """Run a campaign, write its report, and end the program: 0 complete, 1 when a run crashed, 130 interrupted.

    dask: a scheduler's address, to run on its cluster. report: writes what it writes of an outcome, and says its names.
    """
    from rich.console import Console

    from plgrim.evaluation.campaign import run_campaign
    from plgrim.evaluation.campaign_display import CampaignDisplay
    from plgrim.evaluation.campaign_pool import Pool, Runner
    from plgrim.logs import configure_logs
    from plgrim.runtime.process import stop_on_signals

    configure_logs("evaluate")
    console = Console()
    pool: Runner = Pool(jobs or len(os.sched_getaffinity(0)))
    if dask is not None:
        from plgrim.evaluation.campaign_dask import DaskPool

        pool = DaskPool(dask)
    with stop_on_signals() as stop, CampaignDisplay(console) as display:
        outcome = run_campaign(campaign, out, 0, display, stop, force, pool=pool)
    console.print(f"results in {out}/: {report(outcome)}", highlight=False)
    for name in outcome.crashed:
        console.print(f"crashed: {name}: see {out}/runs/{name}/run.log", highlight=False, soft_wrap=True)
    if not outcome.complete:
        console.print("interrupted: the same command goes on with what is missing", highlight=False)
        sys.exit(_INTERRUPTED)
    sys.exit(1 if outcome.crashed else 0)


def register(app: typer.Typer) -> None:
    """Add the command of this file to `plgrim evaluate`."""
    app.command("missions")(missions)
