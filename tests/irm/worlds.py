"""Small flat worlds as risk maps, and what the tests of irm need around them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.footprint import clearance_m
from planning.frames import Planar
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec, overlap, window_around
from schemas.base import Pose
from schemas.sensing import CoverageScan, PoseGraph
from schemas.world import GridHeader, RiskMap
from services.irm.config import Config
from services.irm.footprints import FootprintStore
from services.irm.tiles import TileLayer
from services.irm.window import Window, build_window, grid_of

RADIUS_M = 0.25
DETECTION = 0.95
MAX_CLEARANCE_M = 1.5


@dataclass(slots=True)
class Flat:
    """A flat world: (h, w) states over a grid; outside it everything is unknown."""

    spec: GridSpec
    state: NDArray[np.uint8]

    def risk_map(
        self, x_m: float = 0.0, y_m: float = 0.0, window_m: float | None = None, stamp_ns: int = 1
    ) -> RiskMap:
        """The risk map as a robot at (x, y) has it: the whole world, or a rolling window of it."""
        spec, state = self.spec, self.state
        if window_m is not None:
            spec = window_around(x_m, y_m, window_m, self.spec.resolution_m)
            state = np.full(spec.shape, UNKNOWN, np.uint8)
            common = overlap(self.spec, spec)
            if common is not None:
                state[common[1]] = self.state[common[0]]
        hazard = np.where(state == LETHAL, 2.0, np.where(state == FREE, 0.0, 1.0)).astype(np.float32)
        return RiskMap(
            stamp_ns=stamp_ns,
            grid=GridHeader(
                resolution_m=spec.resolution_m,
                ix0=spec.ix0,
                iy0=spec.iy0,
                width=spec.width,
                height=spec.height,
            ),
            robot_pose=Pose(x_m=x_m, y_m=y_m),
            footprint_radius_m=RADIUS_M,
            state=state,
            hazard_mean=hazard,
            hazard_variance=np.zeros(spec.shape, np.float32),
            hazard_cvar=hazard,
            clearance_m=clearance_m(state == LETHAL, None, None, spec, MAX_CLEARANCE_M),
            elevation_m=np.zeros(spec.shape, np.float32),
            top_m=np.zeros((0, 0), np.float32),
        )

    def fill(self, x_low: float, y_low: float, x_high: float, y_high: float, state: int) -> Flat:
        """Set the cells whose centres lie in a rectangle, m."""
        x, y = np.meshgrid(self.spec.centres_x(), self.spec.centres_y())
        self.state[(x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)] = state
        return self


def room(
    x_low: float, y_low: float, x_high: float, y_high: float, resolution_m: float = 0.1, wall_m: float = 0.2
) -> Flat:
    """A free room with walls around it, and a margin of unknown ground around the walls."""
    margin = round((wall_m + 0.4) / resolution_m)
    ix0, iy0 = round(x_low / resolution_m) - margin, round(y_low / resolution_m) - margin
    width = round(x_high / resolution_m) + margin - ix0
    height = round(y_high / resolution_m) + margin - iy0
    spec = GridSpec(resolution_m, ix0, iy0, width, height)
    flat = Flat(spec, np.full(spec.shape, UNKNOWN, np.uint8))
    flat.fill(x_low - wall_m, y_low - wall_m, x_high + wall_m, y_high + wall_m, LETHAL)
    return flat.fill(x_low, y_low, x_high, y_high, FREE)


def two_rooms(door_m: float = 1.0, resolution_m: float = 0.1) -> Flat:
    """Rooms of 5 x 5 m in x from -5 to 0 and 0.2 to 5.2, joined by a door around y = 0."""
    flat = room(-5.0, -2.5, 5.2, 2.5, resolution_m)
    flat.fill(0.0, -2.5, 0.2, 2.5, LETHAL)
    return flat.fill(0.0, -0.5 * door_m, 0.2, 0.5 * door_m, FREE)


def cluttered(seed: int, side_m: float = 6.0, resolution_m: float = 0.1, boxes: int = 8) -> Flat:
    """A room with boxes at random places; the middle metre stays free."""
    rng = np.random.default_rng(seed)
    flat = room(-side_m / 2, -side_m / 2, side_m / 2, side_m / 2, resolution_m)
    for _ in range(boxes):
        x, y = rng.uniform(-side_m / 2, side_m / 2, 2)
        w, h = rng.uniform(0.1, 1.6, 2)
        flat.fill(x, y, x + w, y + h, LETHAL if rng.random() < 0.8 else UNKNOWN)
    return flat.fill(-0.5, -0.5, 0.5, 0.5, FREE)


@dataclass(slots=True)
class Belief:
    """The layers that irm keeps between windows."""

    config: Config
    ground: TileLayer
    coverage: TileLayer
    store: FootprintStore

    @classmethod
    def new(cls, config: Config, resolution_m: float) -> Belief:
        """Nothing seen yet."""
        coverage = TileLayer("float32", 0.0, resolution_m)
        return cls(config, TileLayer("uint8", 0, resolution_m), coverage, FootprintStore(coverage))

    def window(
        self, risk: RiskMap, x_m: float, y_m: float, penalties: list[tuple[float, float]] | None = None
    ) -> Window:
        """The layers around the robot."""
        spec = grid_of(risk)
        known, log_odds = self.ground.read(spec), self.coverage.read(spec)
        window = build_window(risk, x_m, y_m, self.config, known, log_odds, penalties or [])
        self.ground.write(spec, known)
        return window

    def cover(self, spec: GridSpec, cells: NDArray[np.bool_]) -> None:
        """Mark cells as seen once."""
        layer = self.coverage.read(spec)
        layer[cells] = math.log(DETECTION / (1 - DETECTION))
        self.coverage.write(spec, layer)


def scan_at(
    pose: Planar,
    keyframe_id: int = 0,
    keyframe: Planar = Planar(0.0, 0.0, 0.0),  # noqa: B008
    range_m: float = 3.0,
    fov_rad: float = 2 * math.pi,
    stamp_ns: int = 1,
) -> CoverageScan:
    """A look of the coverage sensor from a pose in odom, joined to a keyframe."""
    local = keyframe.inverse().compose(pose)
    return CoverageScan(
        stamp_ns=stamp_ns,
        keyframe_id=keyframe_id,
        pose_in_odom=Pose(x_m=pose.x_m, y_m=pose.y_m, yaw_rad=pose.yaw_rad),
        pose_in_keyframe=Pose(x_m=local.x_m, y_m=local.y_m, yaw_rad=local.yaw_rad),
        range_m=range_m,
        fov_rad=min(fov_rad, 6.2831853),
        detection_probability=DETECTION,
    )


def pose_graph(keyframes: dict[int, Planar], revision: int = 0, stamp_ns: int = 1) -> PoseGraph:
    """Keyframes as a message."""
    ids = sorted(keyframes)
    return PoseGraph(
        stamp_ns=stamp_ns,
        revision=revision,
        keyframe_id=np.array(ids, np.int64),
        pose_in_map=np.array(
            [(keyframes[k].x_m, keyframes[k].y_m, 0.0, keyframes[k].yaw_rad) for k in ids], np.float64
        ).reshape(-1, 4),
        covariance=np.zeros((len(ids), 3)),
    )
