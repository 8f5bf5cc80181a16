"""`plgrim record`, `replay`: recordings of a running system, and their stages stepped again."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from plgrim.commands.options import ConfigFile


def record(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the segments.")] = Path(
        "out/recording"
    ),
    segment: Annotated[float, typer.Option(min=1, help="Wall seconds of a segment (a file).")] = 60.0,
    max_mb: Annotated[
        float, typer.Option(min=0, help="The oldest segments go when all are larger, MB; 0: never.")
    ] = 0.0,
    raw_only: Annotated[
        bool,
        typer.Option("--raw-only", help="Without the ROS 2 channels: half the size, replays all the same."),
    ] = False,
    base: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Base station's router, to offer the segments there.")
    ] = "",
    config_file: ConfigFile = None,
) -> None:
    """Record a running system as MCAP until Ctrl-C."""
    from plgrim.config import load_config
    from plgrim.logs import configure_logs
    from plgrim.recording.session import run_recorder
    from plgrim.runtime.process import die_with_parent, stop_on_signals

    die_with_parent()
    configure_logs("record")
    config = load_config(config_file)
    with stop_on_signals() as stop:
        counts, lost = run_recorder(config, out, stop, segment, int(max_mb * 1e6), raw_only, base)
    print(f"recorded {sum(counts.values())} messages of {len(counts)} topics in {out}/")
    for reason, count in sorted(lost.items()):
        print(f"lost: {count} {reason}")


def fetch(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the segments.")] = Path(
        "out/from_robot"
    ),
    rate: Annotated[float, typer.Option(min=1, help="At most so many kB/s of the link.")] = 100.0,
    once: Annotated[bool, typer.Option("--once", help="End when all is there.")] = False,
    config_file: ConfigFile = None,
) -> None:
    """Fetch a robot's recorded segments, over a link that may drop, until Ctrl-C."""
    from plgrim.config import load_config
    from plgrim.logs import configure_logs
    from plgrim.recording.session import run_fetch
    from plgrim.runtime.process import stop_on_signals

    configure_logs("fetch")
    config = load_config(config_file)
    with stop_on_signals() as stop:
        fetched, missing = run_fetch(config, out, stop, rate, once)
    left = "no recorder answers" if missing < 0 else f"{missing} still missing"
    print(f"fetched {fetched} segments into {out}/, {left}")
    sys.exit(0 if missing == 0 else 1)


def replay(
    file: Annotated[Path, typer.Argument(help="An .mcap file, or a folder of segments, of `plgrim record`.")],
    speed: Annotated[
        float, typer.Option(min=0, help="Mission seconds a wall second; 0: as fast as the machine can.")
    ] = 0.0,
    stages: Annotated[str, typer.Option(help="Only these stages, with commas.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    config_file: Annotated[
        Path | None, typer.Option("--config", "-c", help="Its sections of stages replace the recorded ones.")
    ] = None,
) -> None:
    """Step the recorded stages again; exit 0 when every output is the same, 1 with the first that differs."""
    from plgrim.config import load_config
    from plgrim.logs import configure_logs
    from plgrim.recording.replay import Replay
    from plgrim.registry import STAGES
    from plgrim.runtime.process import stop_on_signals

    configure_logs("replay")
    wanted = tuple(name.strip() for name in stages.split(",") if name.strip()) or STAGES
    for name in wanted:
        if name not in STAGES:
            raise typer.BadParameter(f"--stages: no stage {name!r}; there are {', '.join(STAGES)}")
    overrides: dict[str, Any] = {}
    if config_file is not None:
        config = load_config(config_file)
        overrides = {name: dict(getattr(config, name)) for name in STAGES}
    with stop_on_signals() as stop:
        report = Replay(wanted, overrides, speed).run(file, stop.is_set)
    if as_json:
        print(json.dumps(report.summary(), indent=2))
    else:
        _print(report)
    sys.exit(0 if report.same else 1)


def _print(report: Any) -> None:
    for warning in report.warnings:
        print(f"warning: {warning}")
    for name in report.steps:
        print(f"{name}: {report.steps[name]} steps, {report.outputs[name]} outputs compared")
    for reason, count in sorted(report.gaps.items()):
        print(f"not stepped: {reason} ({count})")
    for reason, count in sorted(report.before.items()):
        print(f"not recorded whole: {reason} ({count})")
    differences = sorted(report.differences, key=lambda d: d.now_ns)
    if differences:
        print(f"first output that differs: {differences[0]}")
    for other in differences[1:]:
        print(f"also: {other}")
    spent = f"{(report.ended_ns - report.began_ns) / 1e9:.1f} s of the mission in {report.wall_s:.1f} s"
    print(f"{'the same outputs' if report.same else 'NOT the same'}: {spent}")


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(record)
    app.command()(fetch)
    app.command()(replay)
