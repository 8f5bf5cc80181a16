"""`plgrim evaluate rocksample`: the solvers on problems whose answers are published or exact."""

from __future__ import annotations

from typing import Annotated

import typer

from plgrim.errors import ConfigError


def rocksample(
    size: Annotated[tuple[int, int], typer.Option(help="n and k: cells a side, rocks.")] = (11, 11),
    simulations: Annotated[int, typer.Option(min=1, help="Simulations a move.")] = 4096,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes, each with fresh rocks.")] = 1000,
    seed: Annotated[int, typer.Option(help="Of the rocks, the answers and the searches.")] = 2026,
    layout_seed: Annotated[
        int | None, typer.Option(help="A random layout of this seed instead of the published one.")
    ] = None,
    legal: Annotated[
        bool, typer.Option("--legal", help="No knowledge: uniformly random legal rollouts.")
    ] = False,
    speed: Annotated[
        int, typer.Option(min=0, help="Rounds of the interleaved speed run against pomdp-py; 0: none.")
    ] = 0,
) -> None:
    """RockSample(n, k) with our POMCP: mean discounted return and standard error beside the published ones."""
    from plgrim.evaluation.rocksample import evaluate, layout_of
    from plgrim.evaluation.rocksample_model import INFORMED, LEGAL

    try:
        layout = layout_of(*size, layout_seed)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    found = evaluate(
        layout,
        simulations=simulations,
        episodes=episodes,
        seed=seed,
        knowledge=LEGAL if legal else INFORMED,
        progress=lambda done, mean: _progress(done, episodes, mean),
    )
    what = "legal rollouts" if legal else "informed rollouts, preferred actions"
    per_move_ms = 1000.0 * found.cpu_s / max(found.moves, 1)
    _returns(size, layout_seed is None, [
        (f"here: {what}, {simulations} simulations a move", found.mean(), found.standard_error()),
    ])  # fmt: skip
    _say(
        f"{episodes} episodes of {found.moves / episodes:.0f} moves, seed {seed}, {per_move_ms:.1f} ms CPU a move"
    )
    if speed:
        from plgrim.evaluation.rocksample_speed import measure, report

        _say(report(measure(layout, speed)))


def _returns(size: tuple[int, int], published: bool, rows: list[tuple[str, float, float | None]]) -> None:
    from rich.console import Console
    from rich.table import Table

    from plgrim.evaluation.rocksample import PEERS

    table = Table(title=f"RockSample({size[0]}, {size[1]}): discounted return")
    for name in ("solver", "mean", "standard error"):
        table.add_column(name)
    beside = PEERS.get(size, ()) if published else ()
    for source, mean, error in [*rows, *beside]:
        table.add_row(source, f"{mean:.2f}", "" if error is None else f"{error:.2f}")
    Console().print(table)


def _progress(done: int, episodes: int, mean: float) -> None:
    if done % max(1, episodes // 10) == 0 and done < episodes:
        typer.echo(f"{done} of {episodes} episodes, mean {mean:.2f}", err=True)


def _say(text: str) -> None:
    print(text, flush=True)


def register(group: typer.Typer) -> None:
    """Add the commands of this file."""
    group.command()(rocksample)
