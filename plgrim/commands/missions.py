"""`plgrim demo`, `explore`, `up`, `recover`, `watch`: whole missions."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from plgrim.commands.options import (
    ConfigFile,
    DemFile,
    MapFile,
    MeshFile,
    OutFolder,
    Robot,
    Seed,
    Speed,
    StartAt,
    WorldName,
    put,
    world_overrides,
)
from schemas.topics import SERVICES

if TYPE_CHECKING:
    from plgrim.config import Config

_HOLD_FAILED_S = 10.0
"""A simulated mission need not be held for ever when a service has FAILED."""
_DEMO_WORLD = "short_lava_tube"


def demo(
    seed: Annotated[int, typer.Option(min=0, help="Of the world and of every random stream.")] = 1,
    speed: Annotated[float, typer.Option(min=0.01, max=100, help="Mission seconds a wall second.")] = 2.5,
    out: OutFolder = Path("out/demo"),
    config_file: ConfigFile = None,
) -> None:
    """Explore a built-in world, every service a process of its own; exit 0 when it was covered."""
    overrides: dict[str, Any] = {"seed": seed, "clock": {"speed": speed}, "sim": {"world": _DEMO_WORLD}}
    _live(prepare(config_file, overrides), out)


def explore(
    world: WorldName = None,
    map_file: MapFile = None,
    mesh: MeshFile = None,
    dem: DemFile = None,
    robot: Robot = None,
    seed: Seed = None,
    start: StartAt = None,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="One process, virtual clock.")] = False,
    speed: Speed = None,
    time_budget: Annotated[float | None, typer.Option(min=1, help="Mission time, s.")] = None,
    peer_tour: Annotated[
        bool, typer.Option("--peer-tour", help="Compare with what a tour that knows the map covers.")
    ] = False,
    out: OutFolder = Path("out/explore"),
    config_file: ConfigFile = None,
) -> None:
    """Explore a world, a map, a mesh or a height image until it is covered; exit 0 when it was."""
    overrides = world_overrides(world, map_file, mesh, dem, robot, seed, start)
    put(overrides, "clock.speed", speed)
    put(overrides, "mission.time_budget_s", time_budget)
    config = prepare(config_file, overrides)
    if lockstep:
        _lockstep(config, out, peer_tour)
    else:
        _live(config, out, peer_tour=peer_tour)


def up(
    keep: Annotated[bool, typer.Option("--keep", help="Go on after the mission's end.")] = False,
    role: Annotated[
        str | None, typer.Option(help="What this host is: robot, base or all (default: link.host).")
    ] = None,
    new: Annotated[
        bool, typer.Option("--new", help="Begin anew where a mission has not ended: its state is lost.")
    ] = False,
    speed: Speed = None,
    out: OutFolder = Path("out/up"),
    config_file: ConfigFile = None,
) -> None:
    """Start this host's router and services, and watch over them until the mission's end or Ctrl-C."""
    from plgrim.deployment import role_named, role_of, started_by_up
    from plgrim.runtime.run_folder import refuse_unfinished

    if not new:
        refuse_unfinished(out)
    overrides: dict[str, Any] = {}
    put(overrides, "clock.speed", speed)
    if role is not None:
        put(overrides, "link.host", "" if role_named(role) == "all" else role)
    config = prepare(config_file, overrides, with_world=role != "base")
    services = started_by_up(config)
    until_end = not keep and role_of(config) == "all"
    _live(config, out, until_end=until_end, services=services, hold_failed_s=0.0)


def recover(
    folder: Annotated[Path, typer.Argument(help="Result folder of a run that was cut off.")],
    keep: Annotated[bool, typer.Option("--keep", help="Go on after the mission's end.")] = False,
) -> None:
    """Go on with a mission that was cut off (a power cut, Ctrl-C, a shutdown), from the journals in its folder."""
    from plgrim.deployment import started_by_up
    from plgrim.runtime.run_folder import with_kept_state

    config = with_kept_state(folder)
    _live(config, folder, until_end=not keep, services=started_by_up(config), resume=True)


def watch(out: OutFolder = Path("out/watch"), config_file: ConfigFile = None) -> None:
    """Join a running system, show its progress and write the result folder at the mission's end."""
    from plgrim.logs import configure_logs
    from plgrim.missions import watch as watch_mission
    from plgrim.runtime.process import die_with_parent, stop_on_signals

    die_with_parent()
    configure_logs("watch")
    config = prepare(config_file, {}, with_world=False)
    with stop_on_signals() as stop:
        result = watch_mission(config, out, stop, _console())
    _finish(result, out)


def prepare(config_file: Path | None, overrides: dict[str, Any], with_world: bool = True) -> Config:
    """The whole configuration, every section checked, and the world built once: before anything starts."""
    from plgrim.config import check_all, check_service, load_config
    from plgrim.registry import check_world

    config = load_config(config_file, overrides)
    check_all(config)
    if with_world and (options := check_service(config, "sim")) is not None:
        check_world(options)
    return config


def _console() -> Any:
    from rich.console import Console

    return Console()


def _live(
    config: Config,
    out: Path,
    until_end: bool = True,
    peer_tour: bool = False,
    services: tuple[str, ...] = SERVICES,
    hold_failed_s: float = _HOLD_FAILED_S,
    resume: bool = False,
) -> None:
    import time

    from plgrim.logs import configure_logs
    from plgrim.missions import run_live, status_address
    from plgrim.runtime.process import die_with_parent, stop_on_signals
    from plgrim.runtime.router import check_port_free
    from plgrim.security.exposure import check_host

    die_with_parent()
    configure_logs("plgrim")
    check_host(config)
    if until_end and not config.runtime.hold_failed_s:
        runtime = config.runtime.model_copy(update={"hold_failed_s": hold_failed_s})
        config = config.model_copy(update={"runtime": runtime})
    if "status" in services:
        check_port_free(
            *status_address(config),
            "choose another for the status page with PLGRIM_STATUS__PORT, or status.port",
        )
    if config.clock.source == "monotonic" and not config.clock.origin_ns:
        clock = config.clock.model_copy(update={"origin_ns": time.monotonic_ns()})
        config = config.model_copy(update={"clock": clock})
    with stop_on_signals() as stop:
        result = run_live(config, out, stop, _console(), until_end, services, resume=resume)
    _finish(_beside_tour(config, result, out) if peer_tour else result, out)


def _lockstep(config: Config, out: Path, peer_tour: bool) -> None:
    from plgrim.logs import configure_logs
    from plgrim.missions import run_lockstep

    configure_logs("plgrim")
    result = run_lockstep(config, out, _console())
    _finish(_beside_tour(config, result, out) if peer_tour else result, out)


def _beside_tour(config: Config, result: dict[str, Any], out: Path) -> dict[str, Any]:
    """The result with what a tour that knows the map covers in the same time; also in result.json."""
    import json

    from plgrim.config import check_service
    from plgrim.evaluation.tour import TourError, compare, peer_tour
    from services.sim.config import SimConfig

    options = check_service(config, "sim")
    assert isinstance(options, SimConfig)
    try:
        tour = peer_tour(options, float(result["elapsed_s"] or 0.0), lambda text: print(text, flush=True))
    except TourError as error:  # the mission's own result is not lost with it
        print(f"plgrim: no peer: {error}", file=sys.stderr)
        return result
    compared = compare(result, tour)
    (out / "result.json").write_text(json.dumps(compared, indent=2) + "\n", encoding="utf-8")
    return compared


def _finish(result: dict[str, Any], out: Path) -> None:
    from plgrim.progress import stage_table, summary_table

    console = _console()
    console.print(summary_table(result))
    console.print(stage_table(result))
    console.print(f"result in {out}/: result.json, trajectory.csv, coverage.png, map.png", highlight=False)
    console.print(f"as one page: plgrim report {out}", highlight=False)
    sys.exit(0 if result["succeeded"] else 1)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    for command in (demo, explore, up, recover, watch):
        app.command()(command)
