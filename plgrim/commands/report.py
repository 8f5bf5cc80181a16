"""`plgrim report`: a mission as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    path: Annotated[
        Path,
        typer.Argument(
            help="Result folder of a mission or campaign, a recording's folder, or an .mcap file."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The page; default: report.html in the folder.")
    ] = None,
    animate: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of a recording: also an animation, .png (APNG) or .gif."),
    ] = None,
    every: Annotated[float, typer.Option(min=0.1, help="Mission seconds between its frames.")] = 5.0,
) -> None:
    """Make a page of a mission that needs nothing but a browser: map, path, curves, events, parameters."""
    from plgrim.report.page import write_report

    print(f"report: {write_report(path, out)}")
    if animate is not None:
        from plgrim.report.page import write_animation

        print(f"animation: {write_animation(path, animate, every)}")


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(report)
