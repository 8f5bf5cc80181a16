"""Plays a file to riskmap and irm (and gcp) in lock-step, and writes what they made of it."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.graph_mirror import BREADCRUMB, FRONTIER, GraphMirror
from plgrim.config import Config
from plgrim.evaluation.recorder import quantile
from plgrim.feeds.bag import BagOptions, read_bag
from plgrim.feeds.errors import FeedError
from plgrim.feeds.floors import check_one_floor, of_floor
from plgrim.feeds.g2o import read_g2o
from plgrim.feeds.picture import Canvas, feed_picture
from plgrim.feeds.recording import Recording, of_poses
from plgrim.feeds.stage import FEED_SPEC, ONLOOKER_SPEC, FeedStage, Onlooker
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Message
from schemas.contract import SECOND_NS, Stamp, Topic
from schemas.world import CoverageSummary, CoverageWindow, GlobalIrm

_AFTERWARDS_NS = 3 * SECOND_NS
"""The stages go on for so long after the last moment, to take it in."""
BAGS = (".mcap", ".bag", ".db3")


def read_recording(path: Path, options: BagOptions, floor_z_m: float | None) -> Recording:
    """A pose graph (.g2o) or a recording (.mcap, .bag, rosbag2 folder) by its name. Raises FeedError."""
    if path.suffix.lower() == ".g2o":
        return read_pose_graph(path, floor_z_m)
    if floor_z_m is not None:
        raise FeedError(f"{path}: --floor is for pose graphs (.g2o)")
    if path.suffix.lower() in BAGS or path.is_dir():
        return read_bag(path, options)
    raise FeedError(f"{path}: unknown kind of file: .g2o, {', '.join(BAGS)} or a rosbag2 folder are read")


def read_pose_graph(path: Path, floor_z_m: float | None) -> Recording:
    """The drive of a g2o file, through its optimised vertices in the order of their ids. Raises FeedError."""
    graph = read_g2o(path)
    kept = np.arange(len(graph.ids)) if floor_z_m is None else of_floor(str(path), graph.pose, floor_z_m)
    check_one_floor(str(path), graph.ids[kept], graph.pose[kept])
    recording = of_poses(path.stem, graph.pose[kept], np.diff(kept, prepend=kept[0] - 1) != 1)
    recording.facts.update(
        vertices=len(graph.ids), vertices_played=len(kept), edges=graph.edges, loop_closures=graph.closures,
        cost_of_file=graph.cost[0], cost_optimised=graph.cost[1],
    )  # fmt: skip
    return recording


class _Observer:
    """Keeps what the result and the pictures need."""

    def __init__(self) -> None:
        self.canvas, self.mirror = Canvas(), GraphMirror()
        self.summary: CoverageSummary | None = None
        self.coverage: list[tuple[float, CoverageSummary]] = []

    def __call__(self, topic: Topic[Message], message: Message, now: Stamp) -> None:
        match message:
            case CoverageWindow():
                self.canvas.add(message)
            case GlobalIrm():
                self.mirror.apply(message)
            case CoverageSummary():
                self.summary = message
                self.coverage.append((now / SECOND_NS, message))

    def places(self, kind: int) -> NDArray[np.float64]:
        """(n, 2) places of the breadcrumbs or the frontiers in `map`."""
        if not self.mirror.version:
            return np.empty((0, 2))
        road_map = self.mirror.road_map()
        places: NDArray[np.float64] = road_map.xyz_m[road_map.kind == kind][:, :2]
        return places


def play(
    recording: Recording,
    config: Config,
    out_dir: Path,
    with_gcp: bool = False,
    progress: Callable[[float, float], None] = lambda done, share: None,
) -> dict[str, Any]:
    """Play a recording and write result.json, map.png and coverage.png; gives the result.

    progress: called every mission second with the share that has been played and the coverage.
    """
    irm = config.options("irm")
    sensor = (float(irm.get("sensor_range_m", 6.0)), math.radians(float(irm.get("sensor_fov_deg", 120.0))))
    feed, observer = FeedStage(recording, sensor=sensor), _Observer()
    stages = ("riskmap", "irm", "gcp") if with_gcp else ("riskmap", "irm")
    lockstep = Lockstep(
        {name: config.options(name) for name in stages}, config.seed, config.robot, observer, stages,
        extra={"mission": (ONLOOKER_SPEC, Onlooker()), "sim": (FEED_SPEC, feed)},
    )  # fmt: skip
    end_ns, began = recording.end_ns + _AFTERWARDS_NS, time.monotonic()
    while lockstep.now < end_ns:
        lockstep.run_until(min(lockstep.now + SECOND_NS, end_ns))
        covered = observer.summary.covered_fraction if observer.summary else 0.0
        progress(lockstep.now / end_ns, covered)
    extra = {"wall_s": round(time.monotonic() - began, 1), **_of_lockstep(lockstep)}
    return _write(recording, feed, observer, out_dir, extra)


def _of_lockstep(lockstep: Lockstep) -> dict[str, Any]:
    steps = lockstep.step_seconds()
    return {
        "dropped_messages": lockstep.dropped(),
        "digest": lockstep.digest(),
        "step_p50_ms": {name: round(1e3 * (quantile(s, 0.5) or 0.0), 2) for name, s in steps.items()},
        "step_p99_ms": {name: round(1e3 * (quantile(s, 0.99) or 0.0), 2) for name, s in steps.items()},
    }


def _write(
    recording: Recording, feed: FeedStage, observer: _Observer, out_dir: Path, extra: dict[str, Any]
) -> dict[str, Any]:
    from plgrim.evaluation.pictures import coverage_plot

    crumbs, frontiers, last = observer.places(BREADCRUMB), observer.places(FRONTIER), observer.summary
    result: dict[str, Any] = {
        "source": recording.name,
        **recording.facts,
        "moments": len(recording.moments),
        "left_out": dict(sorted(recording.dropped.items())),
        "keyframes": len(feed.keyframes),
        "distance_m": round(recording.length_m, 2),
        "duration_s": recording.end_ns / SECOND_NS,
        "odometry_drift_deg_per_10_m": round(math.degrees(recording.odometry_drift_rad), 2),
        "breadcrumbs": len(crumbs),
        "frontiers": len(frontiers),
        "given_up": dict(sorted(Counter(last.unreachable_reason).items())) if last else {},
        "reachable_area_m2": round(last.reachable_area_m2, 2) if last else 0.0,
        "covered_area_m2": round(last.covered_area_m2, 2) if last else 0.0,
        "coverage": last.covered_fraction if last else 0.0,
        "picture_m2": observer.canvas.areas_m2(),
        **extra,
    }
    out_dir.mkdir(parents=True, exist_ok=True)
    (out_dir / "result.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    title = (
        f"{recording.name}: {result['distance_m']:.0f} m driven, {result['covered_area_m2']:.0f} m² covered"
    )
    feed_picture(out_dir / "map.png", observer.canvas, _driven(recording), crumbs, frontiers, title)
    area_plot(out_dir / "area.png", observer.coverage)
    coverage_plot(out_dir / "coverage.png", [], [(t, s.covered_fraction) for t, s in observer.coverage])
    return result


def area_plot(path: Path, coverage: list[tuple[float, CoverageSummary]]) -> None:
    """Ground known to be reachable and ground covered (m²) over mission time (s)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    times = [t for t, _ in coverage]
    axes.plot(times, [s.reachable_area_m2 for _, s in coverage], label="reachable ground known")
    axes.plot(times, [s.covered_area_m2 for _, s in coverage], label="covered")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("area [m²]")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)


def _driven(recording: Recording) -> NDArray[np.float64]:
    """(n, 2) the path in `map`, with NaN where the recording jumps."""
    rows: list[tuple[float, float]] = []
    for moment in recording.moments:
        if moment.jumped:
            rows.append((math.nan, math.nan))
        rows.append(moment.map[:2])
    return np.array(rows)
