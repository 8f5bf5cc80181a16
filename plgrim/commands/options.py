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
Speed = Annotated[float | None, typer.Option(min=0.01, max=100, help="Mission seconds a wall second.")]


def put(overrides: dict[str, Any], path: str, value: Any) -> None:
    """Set `overrides[a][b] = value` for the path `a.b`, unless the value is None."""
    if value is None:
        return
    *parents, last = path.split(".")
    for part in parents:
        overrides = overrides.setdefault(part, {})
    overrides[last] = value
