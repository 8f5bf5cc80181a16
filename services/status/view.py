"""What the live page is drawn from: references to messages (frozen) and copies, taken at one moment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.graph_mirror import RoadMap
from schemas.fences import Fences
from schemas.policy import GlobalPolicy, Plan
from schemas.sensing import Odometry
from schemas.world import LocalIrm, RiskMap
from services.status.events import Event
from services.status.history import CurvePoint
from services.status.report import StatusReport

NO_POINTS: NDArray[np.float64] = np.empty((0, 2))


class SlowView(NamedTuple):
    """What is told twice a second. began_s: mission clock at the start. step_times: rows as in `StepTimes`."""

    report: StatusReport
    began_s: float | None
    restarts: dict[str, int]
    curve: tuple[CurvePoint, ...]
    step_times: NDArray[np.float32]
    events: tuple[Event, ...]


class View(NamedTuple):
    """The newest of everything; None: nothing received.

    place: x, y, yaw in `map`. old_path: (m, 2) in `odom`. pastes: to ask for the canvas' next changes with.
    tiles: changed tiles of the canvas. trajectory: driven way in `map`.
    """

    odometry: Odometry | None
    place: tuple[float, float, float] | None
    risk: RiskMap | None
    local: LocalIrm | None
    policy: GlobalPolicy | None
    plan: Plan | None
    fences: Fences | None
    old_path: NDArray[np.float64]
    graph: RoadMap
    pastes: int
    tiles: dict[tuple[int, int], NDArray[np.uint8]]
    tile_names: set[tuple[int, int]]
    resolution_m: float
    trajectory: list[tuple[float, float]]
    slow: SlowView | None
