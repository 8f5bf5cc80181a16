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
