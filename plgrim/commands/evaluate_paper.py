"""`plgrim evaluate paper`, `tune` and `reconciliation`: the paper's experiments, as campaigns of missions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from plgrim.commands.evaluate_missions import Dask, Force, Jobs, drive
from plgrim.commands.options import ConfigFile, OutFolder, Robot, put
from plgrim.errors import ConfigError

if TYPE_CHECKING:
    from plgrim.evaluation.campaign import Outcome

T = TypeVar("T")

_WORLD_HELP = "World; again for more. Default: all of the experiment."
Worlds = Annotated[list[str] | None, typer.Option("--world", help=_WORLD_HELP)]
TimeScale = Annotated[
    float, typer.Option(min=0.01, max=10, help="The worlds' time budgets times this: less for a quick look.")
]


def paper(
    world: Worlds = None,
    planner: Annotated[
        list[str] | None, typer.Option(help="plgrim, nbv or hfe; again for more. Default: all three.")
    ] = None,
    seeds: Annotated[str, typer.Option(help="Such as 1-10 or 1,3,5, below 101.")] = "1-10",
    nbv: Annotated[
        Path | None, typer.Option(help="Laid over NBV: best.yaml of `plgrim evaluate tune nbv`.")
    ] = None,
    hfe: Annotated[
        Path | None, typer.Option(help="Laid over HFE: best.yaml of `plgrim evaluate tune hfe`.")
    ] = None,
    time_scale: TimeScale = 1.0,
    robot: Robot = None,
    jobs: Jobs = None,
    dask: Dask = None,
    force: Force = False,
    out: OutFolder = Path("out/paper"),
    config_file: ConfigFile = None,
) -> None:
    """The paper's experiments: PLGRIM, NBV and HFE in six worlds, the same seeds for all; finished runs are kept.

    Time budgets: subway_1x 900 s, subway_2x, maze and cave 1800 s, subway_3x 2700 s, lava_tube 1500 s. Result:
    runs.csv (a row a run), coverage.png (a panel a world), paper.md (the table).
    """
    from plgrim.evaluation.campaign_plan import Campaign, Variant, parse_seeds, read_overlay
    from plgrim.evaluation.paper import BUDGETS_S, paper_text, paper_variants, paper_worlds
    from plgrim.evaluation.tuning import check_scored_seeds

    numbers = parse_seeds(seeds)
    check_scored_seeds(numbers)
    own = {name: read_overlay(file) for name, file in (("nbv", nbv), ("hfe", hfe)) if file is not None}
    variants: list[Variant] = _chosen("planner", {v.name: v for v in paper_variants(own)}, planner)
    names = _chosen("world", dict(zip(BUDGETS_S, BUDGETS_S, strict=True)), world)
    campaign = Campaign(paper_worlds(names, time_scale), variants, numbers, 0.0, config_file, _common(robot))

    def report(outcome: Outcome) -> str:
        _write(out / "paper.md", paper_text(_rows_of(outcome, campaign), "The paper's experiments"))
        return "paper.md, runs.csv, coverage.png, summary.md, runs/"

    drive(campaign, out, jobs, dask, force, report)


def tune(
    planner: Annotated[str, typer.Argument(help="nbv or hfe.")],
    world: Worlds = None,
    seeds: Annotated[
        str, typer.Option(help="Such as 101-103: from 101 on, which are never scored.")
    ] = "101-103",
    variant: Annotated[
        list[str] | None, typer.Option(help="Of the grid; again for more. Default: all of it.")
    ] = None,
    time_scale: TimeScale = 1.0,
    robot: Robot = None,
    jobs: Jobs = None,
    dask: Dask = None,
    force: Force = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Default: out/tune_PLANNER.")] = None,
    config_file: ConfigFile = None,
) -> None:
    """Tune a baseline: each parameter around its default, one at a time, on seeds that are never scored.

    Result: ranking.md (by mean area under the coverage curve), best.yaml for `plgrim evaluate paper`.
    """
    from plgrim.evaluation.campaign_plan import Campaign, parse_seeds
    from plgrim.evaluation.paper import BUDGETS_S, paper_worlds
    from plgrim.evaluation.tuning import GRID, check_tuning_seeds, tuning_variants, write_tuning

    _chosen("planner", GRID, [planner])
    numbers = parse_seeds(seeds)
    check_tuning_seeds(numbers)
    names = _chosen("world", dict(zip(BUDGETS_S, BUDGETS_S, strict=True)), world)
    worlds, variants = paper_worlds(names, time_scale), tuning_variants(planner, variant or ())
    campaign = Campaign(worlds, variants, numbers, 0.0, config_file, _common(robot))
    folder = out or Path(f"out/tune_{planner}")

    def report(outcome: Outcome) -> str:
        best = write_tuning(folder, planner, _rows_of(outcome, campaign), worlds)
        return f"ranking.md, best.yaml ({best}), runs.csv, coverage.png, summary.md, runs/"

    drive(campaign, folder, jobs, dask, force, report)


def reconciliation(
    world: Worlds = None,
    seeds: Annotated[str, typer.Option(help="Such as 1-10 or 1,3,5.")] = "1-10",
    time_scale: TimeScale = 1.0,
    robot: Robot = None,
    jobs: Jobs = None,
    dask: Dask = None,
    force: Force = False,
    out: OutFolder = Path("out/reconciliation"),
    config_file: ConfigFile = None,
) -> None:
    """What reconciliation is good for: tau* (and the paper's literal rule) against always-new and always-old.

    Heading jumps, turning, target switches, distance, and how soon plans heed a block that comes down before the robot.
    """
    from plgrim.evaluation.campaign_plan import Campaign, parse_seeds
    from plgrim.evaluation.reconciliation import (
        BUDGETS_S,
        reconciliation_text,
        reconciliation_variants,
        reconciliation_worlds,
    )

    names = _chosen("world", dict(zip(BUDGETS_S, BUDGETS_S, strict=True)), world)
    worlds = reconciliation_worlds(names, time_scale)
    campaign = Campaign(
        worlds, reconciliation_variants(), parse_seeds(seeds), 0.0, config_file, _common(robot)
    )

    def report(outcome: Outcome) -> str:
        text = reconciliation_text(_rows_of(outcome, campaign), "Reconciliation against its ablations")
        _write(out / "reconciliation.md", text)
        return "reconciliation.md, runs.csv, coverage.png, summary.md, runs/"

    drive(campaign, out, jobs, dask, force, report)


def _chosen(what: str, known: Mapping[str, T], names: Sequence[str] | None) -> list[T]:
    """Those that were asked for, all when none was. Raises ConfigError for one that there is not."""
    for name in names or ():
        if name not in known:
            raise ConfigError(f"{what} {name!r} is not one of {', '.join(known)}")
    return [known[name] for name in names or known]


def _common(robot: str | None) -> dict[str, Any]:
    common: dict[str, Any] = {}
    put(common, "profile", robot)
    return common


def _rows_of(outcome: Outcome, campaign: Any) -> list[dict[str, Any]]:
    """The rows of this campaign; the folder may hold those of others."""
    own = {run.fingerprint for run in campaign.runs()}
    return [row for row in outcome.table if row["fingerprint"] in own]


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def register(group: typer.Typer) -> None:
    """Add the commands of this file to `plgrim evaluate`."""
    group.command("paper")(paper)
    group.command("tune")(tune)
    group.command("reconciliation")(reconciliation)
