"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", "-c", help="YAML or TOML file; default: $PLGRIM_CONFIG, or the defaults."),
]
OutFolder = Annotated[Path, typer.Option("--out", "-o", help="Result folder.")]
MeshFile = Annotated[
    Path | None,
    typer.Option("--mesh", help="Mesh (OBJ, STL, PLY, DAE; metres, z up) instead of a built-in world."),
]
DemFile = Annotated[
    Path | None,
    typer.Option("--dem", help="Height image (npy, GeoTIFF, 16-bit PNG) instead of a built-in world."),
]
MapFile = Annotated[
    Path | None, typer.Option("--map", help="ROS map_server YAML file instead of a built-in world.")
]
WorldName = Annotated[str | None, typer.Option(help="Built-in world: subway_1x, subway_2x, ...")]
Seed = Annotated[int | None, typer.Option(min=0, help="Of the world and of every random stream.")]
StartAt = Annotated[
    tuple[float, float] | None, typer.Option(metavar="X Y", help="Start in the map's frame, m.")
]
Robot = Annotated[str | None, typer.Option("--robot", help="Robot profile: husky or spot.")]
Speed = Annotated[float | None, typer.Option(min=0.01, max=100, help="Mission seconds a wall second.")]


def put(overrides: dict[str, Any], path: str, value: Any) -> None:
    """Set `overrides[a][b] = value` for the path `a.b`, unless the value is None."""
    if value is None:
        return
    *parents, last = path.split(".")
    for part in parents:
        overrides = overrides.setdefault(part, {})
    overrides[last] = value


def world_overrides(
    world: str | None,
    map_file: Path | None,
    mesh: Path | None,
    dem: Path | None,
    robot: str | None,
    seed: int | None,
    start: tuple[float, float] | None,
) -> dict[str, Any]:
    """The configuration that the options about world and robot ask for. Raises BadParameter."""
    if sum(given is not None for given in (world, map_file, mesh, dem)) > 1:
        raise typer.BadParameter("--world, --map, --mesh and --dem exclude each other")
    overrides: dict[str, Any] = {}
    put(overrides, "seed", seed)
    put(overrides, "sim.world", world)
    put(overrides, "sim.map_file", None if map_file is None else str(map_file.resolve()))
    put(overrides, "sim.mesh_file", None if mesh is None else str(mesh.resolve()))
    put(overrides, "sim.dem_file", None if dem is None else str(dem.resolve()))
    put(overrides, "profile", robot)
    put(overrides, "sim.start", None if start is None else {"x_m": start[0], "y_m": start[1]})
    return overrides
