"""`plgrim evaluate ...`: experiments, each with figures and tables as its result."""

from __future__ import annotations

import typer

from plgrim.commands import (
    evaluate_grid,
    evaluate_missions,
    evaluate_paper,
    evaluate_solvers,
    evaluate_tour,
)


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    group = typer.Typer(
        name="evaluate", help="Experiments: campaigns of missions, and peers.", no_args_is_help=True
    )
    evaluate_missions.register(group)
    evaluate_paper.register(group)
    evaluate_tour.register(group)
    evaluate_solvers.register(group)
    evaluate_grid.register(group)
    app.add_typer(group)
