"""`plgrim feed FILE`: pose graphs and recordings instead of the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from plgrim.commands.options import ConfigFile, OutFolder

_MUCH_DRIFT_DEG = 3.0
"""More than this per 10 m, and the risk map's window holds no map of one place any more."""


def feed(
    file: Annotated[Path, typer.Argument(help="Pose graph (.g2o), .mcap, ROS 1 .bag, or rosbag2 folder.")],
    out: OutFolder = Path("out/feed"),
    floor: Annotated[
        float | None, typer.Option(metavar="Z", help="Of a pose graph: only keyframes of this height, m.")
    ] = None,
    corrected: Annotated[
        bool, typer.Option("--corrected", help="Take the corrected poses as odometry too.")
    ] = False,
    scan: Annotated[str, typer.Option(help="Topic of the laser scans.")] = "/scan",
    odom: Annotated[str, typer.Option(help="Topic of the odometry.")] = "/odom",
    pose: Annotated[str, typer.Option(help="Topic of the corrected poses.")] = "/pose_corrected",
    height: Annotated[float, typer.Option(min=0.0, help="Of the laser above the floor, m.")] = 0.4,
    longest_gap: Annotated[float, typer.Option(min=0.05, help="Longer pauses are cut to this, s.")] = 0.5,
    gcp: Annotated[bool, typer.Option("--gcp", help="Run gcp too.")] = False,
    config_file: ConfigFile = None,
) -> None:
    """Play a file to riskmap and irm in lock-step; write what they made of it: result.json and pictures."""
    from rich.console import Console
    from rich.progress import Progress

    from plgrim.config import check_all, load_config
    from plgrim.feeds.bag import BagOptions
    from plgrim.feeds.run import play, read_recording
    from plgrim.logs import configure_logs

    configure_logs("feed")
    config = load_config(config_file)
    check_all(config)
    options = BagOptions(scan, odom, pose, corrected, longest_gap, height)
    recording = read_recording(file, options, floor)
    console = Console()
    with Progress(console=console) as bar:
        task = bar.add_task(recording.name, total=1.0)

        def show(share: float, coverage: float) -> None:
            bar.update(task, completed=share, description=f"{recording.name}: {100 * coverage:.1f} % covered")

        result = play(recording, config, out, gcp, show)
    for key in (
        "moments",
        "keyframes",
        "distance_m",
        "breadcrumbs",
        "frontiers",
        "covered_area_m2",
        "coverage",
    ):
        console.print(f"{key}: {result[key]:g}", highlight=False)
    for reason, count in result["left_out"].items():
        console.print(f"left out: {count} {reason}", highlight=False)
    drift_deg = result["odometry_drift_deg_per_10_m"]
    if drift_deg > _MUCH_DRIFT_DEG:
        console.print(
            f"odometry turns by {drift_deg:g} degrees per 10 m against the corrected poses: ground that is seen "
            "again lies in several places; --corrected takes the corrected poses as odometry too",
            style="yellow",
            highlight=False,
        )
    console.print(f"result in {out}/: result.json, map.png, area.png, coverage.png", highlight=False)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(feed)
