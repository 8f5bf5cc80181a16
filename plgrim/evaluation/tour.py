"""The peer of a mission: what a tour that knows the map covers in the same time.

The tour: viewpoints from which all reachable ground can be seen (greedy set cover by the judge's own line of sight),
ordered by nearest neighbour and 2-opt as an open tour, driven by the simulator's own follower and robot, and scored by
the simulator's own judge. It is better off than any explorer: it knows the ground, its pose is true, its wheels do not
slip, nobody is in its way, and it is free to turn back at the last second. Of several tours, which differ in how little
they go out of their way for, the one that covers most in the time is the peer.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import spatial

import planning.kernels
from plgrim.errors import PlgrimError
from plgrim.evaluation.known_ground import KnownGround, Points
from plgrim.evaluation.tour_drive import Column, Driven, drive_tour
from plgrim.evaluation.tour_plan import Rehearsed, TourPlanner
from plgrim.evaluation.viewpoints import Tell
from services.sim.config import SimConfig
from services.sim.coverage import Judge
from services.sim.raster_cache import Arrays, cached
from services.sim.world import World
from services.sim.worlds import build_world

ROUNDS_M2: tuple[tuple[float, ...], ...] = (
    (0.2, 0.1),
    (1.0, 0.2, 0.1),
    (4.0, 0.5, 0.1),
    (10.0, 1.0, 0.2),
    (25.0, 5.0, 1.0),
)
"""The tours that are tried: the least area, m2, that a viewpoint is visited for in each of their rounds."""
_TRIES = 4
"""Ground that loses the robot is left out of the next try."""
_LEFT_OUT_M = 0.8
_SPARE = 1.1
"""So much longer than the drive is what is planned: the times of a plan are estimates."""
_REACHED_M = 0.5
_ROUNDED_S = 10.0
"""Tours are planned for whole multiples of this, so that missions that end at nearly the same time share one."""


class TourError(PlgrimError):
    """No tour of this world ends with the robot whole."""


@dataclass(frozen=True)
class Tour:
    """A driven tour. Columns float64[n], one row a look of the judge (the coverage sensor's rate), from time 0."""

    time_s: Column
    covered_m2: Column
    x_m: Column
    y_m: Column
    yaw_rad: Column
    stops_m: Points
    """(k, 2): where the viewpoints that were visited have been seen from."""
    reachable_m2: float
    viewpoints: int
    """Of the first round, all of which its order visits."""
    nearest_neighbour_m: float
    """Length of that order, as cost: metres near the rim count more."""
    two_opt_m: float
    """The same after 2-opt."""
    length_m: float
    """Driven."""
    least_m2: float
    """The least area that a viewpoint of the first round is visited for."""
    contacts: int
    skipped: int
    finished: bool
    """Everything worth a visit was visited before the time was over."""

    def covered_at(self, time_s: float) -> float:
        """Area covered after so long, m2; after the tour's end, what it has covered by then."""
        return float(np.interp(time_s, self.time_s, self.covered_m2))

    def summary(self, time_s: float) -> dict[str, Any]:
        """The tour's figures after so long, as plain values."""
        covered_m2 = self.covered_at(time_s)
        figures = {f.name: getattr(self, f.name) for f in fields(self)}
        return {
            "time_s": time_s,
            "covered_area_m2": covered_m2,
            "reachable_area_m2": self.reachable_m2,
            "coverage": covered_m2 / self.reachable_m2,
            "driven_s": float(self.time_s[-1]),
            "stops": len(self.stops_m),
            **{
                name: value
                for name, value in figures.items()
                if isinstance(value, int | float) and name != "reachable_m2"
            },
        }


def tour_world(config: SimConfig) -> World:
    """The world of a configuration as the tour has it: nobody walks in it, and no door closes."""
    return replace(build_world(config), movers=(), doors=())


def tour_judge(world: World, config: SimConfig) -> Judge:
    """The judge as the simulator makes it for this configuration."""
    robot = config.robot
    return Judge(world, robot.footprint_radius_m, config.coverage_sensor, robot, config.lidar.height_m)


def make_tour(
    world: World,
    config: SimConfig,
    time_s: float,
    tell: Tell,
    rounds_m2: Sequence[Sequence[float]] = ROUNDS_M2,
) -> Tour:
    """Plan and drive tours of a world for so long, and give the best. Raises TourError when each loses the robot."""
    judge = tour_judge(world, config)
    tell(f"{world.name}: {judge.reachable_area_m2:.0f} m2 can be reached")
    ground = KnownGround(judge.spec, judge.roamed)
    reasons: list[str] = []
    for _ in range(_TRIES):
        planner = TourPlanner(world, config, judge, ground, tell)
        found = [_attempt(planner, world, config, judge, rounds, time_s, tell) for rounds in rounds_m2]
        whole = [(plan, driven, rounds) for plan, driven, rounds in found if not driven.lost_reason]
        if whole:
            return _tour(*max(whole, key=lambda one: _merit(one[1])), judge)
        for _, driven, _ in found:
            reasons.append(f"({driven.x_m[-1]:.2f}, {driven.y_m[-1]:.2f}) {driven.lost_reason}")
            ground = ground.without(driven.x_m[-1], driven.y_m[-1], _LEFT_OUT_M)
        ground = ground.part_with(*world.start[:2])
    raise TourError(f"every tour of {world.name} loses the robot: {'; '.join(reasons)}")


def _attempt(
    planner: TourPlanner,
    world: World,
    config: SimConfig,
    judge: Judge,
    rounds: Sequence[float],
    time_s: float,
    tell: Tell,
) -> tuple[Rehearsed, Driven, Sequence[float]]:
    plan = planner.rehearse(rounds, _SPARE * time_s)
    driven = drive_tour(world, config, judge, planner.ground, plan.stretches, time_s)
    tell(
        f"viewpoints from {rounds[0]:g} m2 on: {driven.covered_m2[-1]:.0f} m2 in {driven.time_s[-1]:.0f} s, "
        f"{driven.length_m:.0f} m" + (f", lost: {driven.lost_reason}" if driven.lost_reason else "")
    )
    return plan, driven, rounds


def _merit(driven: Driven) -> tuple[float, float]:
    """Most covered; of equal ones, soonest."""
    return float(driven.covered_m2[-1]), -float(driven.time_s[-1])


def _tour(plan: Rehearsed, driven: Driven, rounds: Sequence[float], judge: Judge) -> Tour:
    return Tour(
        time_s=driven.time_s,
        covered_m2=driven.covered_m2,
        x_m=driven.x_m,
        y_m=driven.y_m,
        yaw_rad=driven.yaw_rad,
        stops_m=plan.stops_m[passed(plan.stops_m, driven)],
        reachable_m2=judge.reachable_area_m2,
        viewpoints=plan.viewpoints,
        nearest_neighbour_m=plan.nearest_neighbour_m,
        two_opt_m=plan.two_opt_m,
        length_m=driven.length_m,
        least_m2=float(rounds[0]),
        contacts=driven.contacts,
        skipped=driven.skipped,
        finished=driven.finished,
    )


def passed(stops_m: Points, driven: Driven) -> NDArray[np.bool_]:
    """Which of the planned stops (n, 2) the drive came to before its time was over."""
    track = spatial.cKDTree(np.stack([driven.x_m, driven.y_m], axis=1))
    return np.asarray(track.query(stops_m)[0] <= _REACHED_M) if len(stops_m) else np.zeros(0, np.bool_)


def peer_tour(config: SimConfig, time_s: float, tell: Tell) -> Tour:
    """The tour of a configuration's world for a mission of so long, from the cache on disk if it is there.

    It depends on the world, the robot, its coverage sensor and the code, and on nothing random.
    """
    world = tour_world(config)
    planned_s = _ROUNDED_S * math.ceil(time_s / _ROUNDED_S - 1e-6)

    def make() -> Arrays:
        return {
            name: np.asarray(value) for name, value in _columns(make_tour(world, config, planned_s, tell))
        }

    stored = cached(_content(world), f"tour {planned_s} {_recipe(config)}", make)
    return Tour(**{f.name: _plain(stored[f.name], str(f.type)) for f in fields(Tour)})


def _columns(tour: Tour) -> list[tuple[str, Any]]:
    return [(f.name, getattr(tour, f.name)) for f in fields(tour)]


def _plain(value: Any, kind: str) -> Any:
    """A stored number as the type of its field."""
    return value.item() if kind in ("int", "float", "bool") else value


def _content(world: World) -> bytes:
    """A digest of all that the tour sees of a world."""
    digest = hashlib.sha256(json.dumps([world.name, *world.spec, *world.start]).encode())
    for grid in (world.occupied, world.floor_m, world.ceiling_m):
        digest.update(b"-" if grid is None else np.ascontiguousarray(grid).tobytes())
    return digest.digest()


def _recipe(config: SimConfig) -> str:
    """The robot, its sensor and the code: what else decides about a tour."""
    code = hashlib.sha256(planning.kernels.cache_directory().name.encode())
    here = Path(__file__).resolve()
    for name in ("known_ground.py", "viewpoints.py", "tour_plan.py", "tour_drive.py", here.name):
        code.update((here.parent / name).read_bytes())
    for name in ("follower.py", "config.py"):
        code.update((here.parents[2] / "services" / "sim" / name).read_bytes())
    parts = config.model_dump_json(include={"robot", "coverage_sensor", "slope_slip_fraction"})
    limits = {"lost_mps": config.contact_lost_speed_mps, "sensor_m": config.lidar.height_m}
    return f"{code.hexdigest()} {parts} {json.dumps(limits)}"


def compare(result: dict[str, Any], tour: Tour) -> dict[str, Any]:
    """A mission's result with the tour's figures for the same time under `tour`, and the ratio of the areas."""
    summary = tour.summary(float(result["elapsed_s"] or 0.0))
    mine, other = result["covered_area_m2"], summary["covered_area_m2"]
    summary["ratio"] = None if mine is None or other <= 0.0 else mine / other
    return {**result, "tour": summary}


def write_tour(tour: Tour, config: SimConfig, time_s: float, out_dir: Path) -> dict[str, Any]:
    """Write tour.json (figures, and once a second where it was and what it had covered) and tour.png; the figures."""
    from plgrim.evaluation.pictures import map_picture  # matplotlib: only when it is needed
    from services.sim.stage import world_picture

    out_dir.mkdir(parents=True, exist_ok=True)
    world = tour_world(config)
    until = int(np.searchsorted(tour.time_s, time_s, side="right"))
    poses = np.stack([tour.x_m, tour.y_m, tour.yaw_rad], axis=1)[:until]
    judge = tour_judge(world, config)
    for pose in poses.tolist():
        judge.update(*pose)
    summary = {"world": world.name, **tour.summary(time_s)}
    title = (
        f"{world.name}: a tour that knows the map covers {100 * summary['coverage']:.1f} % in {time_s:.0f} s"
    )
    map_picture(
        out_dir / "tour.png", world_picture(judge, 0), poses[:, :2].tolist(), title, tour.stops_m.tolist()
    )
    each = max(1, round(config.coverage_sensor.rate_hz))
    track = {
        name: np.round(getattr(tour, name)[:until:each], 3).tolist()
        for name in ("time_s", "covered_m2", "x_m", "y_m", "yaw_rad")
    }
    text = json.dumps({**summary, "track": track, "stops_m": np.round(tour.stops_m, 3).tolist()})
    (out_dir / "tour.json").write_text(text + "\n", encoding="utf-8")
    return summary
