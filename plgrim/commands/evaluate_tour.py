"""`plgrim evaluate tour`: what to hold a mission against."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from plgrim.commands.options import (
    ConfigFile,
    DemFile,
    MapFile,
    MeshFile,
    OutFolder,
    Robot,
    Seed,
    StartAt,
    WorldName,
    world_overrides,
)


def tour(
    world: WorldName = None,
    map_file: MapFile = None,
    mesh: MeshFile = None,
    dem: DemFile = None,
    robot: Robot = None,
    seed: Seed = None,
    start: StartAt = None,
    time_budget: Annotated[float, typer.Option(min=1, help="Time of the drive, s.")] = 3600.0,
    out: OutFolder = Path("out/tour"),
    config_file: ConfigFile = None,
) -> None:
    """What a tour that knows the map (nearest neighbour and 2-opt over viewpoints) covers in a time."""
    from plgrim.commands.missions import prepare
    from plgrim.config import check_service
    from plgrim.evaluation.tour import peer_tour, write_tour
    from services.sim.config import SimConfig

    config = prepare(config_file, world_overrides(world, map_file, mesh, dem, robot, seed, start))
    options = check_service(config, "sim")
    assert isinstance(options, SimConfig)
    found = peer_tour(options, time_budget, say)
    _print_tour(write_tour(found, options, time_budget, out))
    say(f"result in {out}/: tour.json, tour.png")


def say(text: str) -> None:
    """Print a line."""
    print(text, flush=True)


def _print_tour(summary: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"a tour that knows {summary['world']}", show_header=False)
    order = f"nearest neighbour {summary['nearest_neighbour_m']:.0f} m, 2-opt {summary['two_opt_m']:.0f} m"
    rows = {
        "viewpoints": f"{summary['viewpoints']} ({order}), {summary['stops']} visited",
        "driven": f"{summary['length_m']:.0f} m in {summary['driven_s']:.0f} s",
        f"covered in {summary['time_s']:.0f} s": f"{summary['covered_area_m2']:.0f} m2, "
        f"{100 * summary['coverage']:.1f} % of {summary['reachable_area_m2']:.0f} m2",
        "contacts": str(summary["contacts"]),
    }
    for name, value in rows.items():
        table.add_row(name, value)
    Console().print(table)


def register(group: typer.Typer) -> None:
    """Add the commands of this file."""
    group.command()(tour)
