"""A robot in a small world whose every input the test can stop or change, around one real reconciler.

The Local IRM comes from the real irm, the answers from the real lcp; the robot follows its plan exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from planning.footprint import clearance_m
from planning.grid import FREE, LETHAL, GridSpec
from schemas.base import Pose
from schemas.contract import SECOND_NS, Outputs, StageSetup, Topic
from schemas.operation import MissionPhase
from schemas.policy import EpisodeRequest, LocalPolicy, Plan
from schemas.sensing import FollowerState, Odometry
from schemas.topics import EPISODE, FOLLOWER, LOCAL_IRM, LOCAL_POLICY, MISSION, ODOMETRY, PLAN, RISK_MAP
from schemas.world import GridHeader, LocalIrm, RiskMap
from services.irm import stage as irm_stage
from services.lcp import stage as lcp_stage
from services.reconciler import stage as reconciler_stage
from services.reconciler.config import Config
from tests.lcp.local_irms import mission
from tests.runtime.feeding import Feed, M, only

TICK_NS = SECOND_NS // 10
RESOLUTION_M = 0.2
FOOTPRINT_M = 0.25
IRM_SIZE = 21
LCP = lcp_stage.Config(max_nodes=4000, min_visits=4)


def room(columns: int = 100, rows: int = 60) -> NDArray[np.bool_]:
    """A walled room of 20 m by 12 m around the origin, as lethal cells of 0.2 m."""
    lethal = np.zeros((rows, columns), np.bool_)
    lethal[[0, -1], :] = lethal[:, [0, -1]] = True
    return lethal


@dataclass
class Rig:
    """`tick()` is a tenth of a second. What the switches stop does not arrive at the reconciler any more."""

    config: Config = field(default_factory=lambda: Config(simulations=256))
    seed: int = 3
    lethal: NDArray[np.bool_] = field(default_factory=room)
    phase: MissionPhase = MissionPhase.EXPLORE
    send_risk: bool = True
    send_odometry: bool = True
    send_irm: bool = True
    answer: bool = True
    answer_delay: int = 3
    moving: bool = True
    follower_blocked: bool = False

    def __post_init__(self) -> None:
        setup = StageSetup("robot", self.seed)
        self.reconciler = Feed("reconciler", reconciler_stage.create(self.config, setup))
        self.irm = Feed("irm", irm_stage.create(irm_stage.Config(size=IRM_SIZE, sensor_range_m=3.0), setup))
        self.lcp = Feed("lcp", lcp_stage.create(LCP, setup))
        self.ticks = -1
        self.x_m = self.y_m = self.yaw_rad = self.speed_mps = 0.0
        self.plans: list[Plan] = []
        self.requests: list[EpisodeRequest] = []
        self.answers: list[tuple[int, LocalPolicy]] = []
        self.delivered: list[LocalPolicy] = []
        self.irms: dict[int, LocalIrm] = {}
        self.grid = GridSpec(
            RESOLUTION_M, -self.lethal.shape[1] // 2, -self.lethal.shape[0] // 2, *self.lethal.shape[::-1]
        )

    @property
    def now(self) -> int:
        """The clock, ns."""
        return self.ticks * TICK_NS

    def last(self) -> Plan:
        """The plan that was published last."""
        return self.plans[-1]

    def run(self, seconds: float) -> None:
        """Many ticks."""
        for _ in range(round(seconds * 10)):
            self.tick()

    def tick(self) -> Outputs:
        """A tenth of a second: the robot moves, inputs arrive, the reconciler steps."""
        self.ticks += 1
        if self.moving:
            self._drive()
        if self.send_odometry:
            self._both(ODOMETRY, self.odometry())
        if self.phase:
            self.reconciler.put(MISSION, mission(self.phase, self.now), self.now)
        if self.send_risk and self.ticks % 2 == 0:
            self._both(RISK_MAP, self.risk_map())
        if self.plans:
            self.reconciler.put(FOLLOWER, self._follower(), self.now)
        if self.send_irm and self.ticks % 5 == 0:
            self._local_irm()
        self._deliver()
        return self._collect(self.reconciler.step(self.now))

    def _both(self, topic: Topic[M], message: M) -> None:
        self.reconciler.put(topic, message, self.now)
        self.irm.put(topic, message, self.now)

    def _local_irm(self) -> None:
        found = only(self.irm.step(self.now), LOCAL_IRM)
        if found is not None:
            self.irms[found.irm_version] = found
            self.reconciler.put(LOCAL_IRM, found, self.now)
            self.lcp.put(LOCAL_IRM, found, self.now)
            self.lcp.step(self.now)

    def _deliver(self) -> None:
        while self.answers and self.answers[0][0] <= self.ticks:
            policy = self.answers.pop(0)[1]
            self.delivered.append(policy)
            self.reconciler.put(LOCAL_POLICY, policy, self.now)

    def _collect(self, outputs: Outputs) -> Outputs:
        wanted = only(outputs, EPISODE)
        if wanted is not None:
            self.requests.append(wanted)
            if self.answer:
                self.lcp.put(EPISODE, wanted, self.now)
                policy = only(self.lcp.step(self.now), LOCAL_POLICY)
                assert policy is not None
                self.answers.append((self.ticks + self.answer_delay, policy))
        plan = only(outputs, PLAN)
        if plan is not None:
            self.plans.append(plan)
        return outputs

    def _drive(self) -> None:
        """Along the plan, at its speed, as far as a tenth of a second goes."""
        if not self.plans or not self.last().valid or len(self.last().x_m) < 2:
            self.speed_mps = 0.0
            return
        line = np.stack([self.last().x_m, self.last().y_m], axis=1)[:40]
        at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        fine = np.arange(0.0, at[-1], 0.01)
        off = np.hypot(np.interp(fine, at, line[:, 0]) - self.x_m, np.interp(fine, at, line[:, 1]) - self.y_m)
        along = float(fine[int(np.argmin(off))]) if len(fine) else 0.0
        self.speed_mps = float(np.interp(along, at, self.last().speed_mps[:40]))
        ahead = min(along + 0.1 * self.speed_mps, at[-1])
        x, y = float(np.interp(ahead, at, line[:, 0])), float(np.interp(ahead, at, line[:, 1]))
        if math.hypot(x - self.x_m, y - self.y_m) > 1e-3:
            self.yaw_rad = math.atan2(y - self.y_m, x - self.x_m)
        self.x_m, self.y_m = x, y

    def _follower(self) -> FollowerState:
        return FollowerState(
            stamp_ns=self.now,
            plan_id=self.last().plan_id,
            progress_m=0.0,
            tracking_error_m=0.0,
            stuck=False,
            blocked=self.follower_blocked,
            contacts=0,
        )

    def odometry(self) -> Odometry:
        """The pose of this moment."""
        return Odometry(
            stamp_ns=self.now,
            pose=Pose(x_m=self.x_m, y_m=self.y_m, yaw_rad=self.yaw_rad),
            map_to_odom=Pose(),
            speed_mps=self.speed_mps,
            turn_rate_radps=0.0,
            covariance=np.diag([1e-4, 1e-4, 1e-4]),
        )

    def risk_map(self) -> RiskMap:
        """The world as it is now."""
        s = self.grid
        zero = np.zeros(s.shape, np.float32)
        return RiskMap(
            stamp_ns=self.now,
            grid=GridHeader(
                resolution_m=s.resolution_m, ix0=s.ix0, iy0=s.iy0, width=s.width, height=s.height
            ),
            robot_pose=Pose(x_m=self.x_m, y_m=self.y_m, yaw_rad=self.yaw_rad),
            footprint_radius_m=FOOTPRINT_M,
            state=np.where(self.lethal, LETHAL, FREE).astype(np.uint8),
            hazard_mean=zero,
            hazard_variance=zero,
            hazard_cvar=zero,
            clearance_m=clearance_m(self.lethal, None, None, s),
            elevation_m=zero,
            top_m=np.zeros((0, 0), np.float32),
        )

    def wall_at(self, x_m: float, y_m: float, half_m: float = 0.3) -> None:
        """From now on there is an obstacle."""
        for row in range(self.grid.height):
            for column in range(self.grid.width):
                x, y = self.grid.centre_of(row, column)
                if max(abs(x - x_m), abs(y - y_m)) <= half_m:
                    self.lethal[row, column] = True

    def clearance_at(self, x_m: float, y_m: float) -> float:
        """Distance to the nearest lethal cell's centre."""
        cells = np.argwhere(self.lethal)
        s = self.grid
        x = (s.ix0 + cells[:, 1] + 0.5) * s.resolution_m
        y = (s.iy0 + cells[:, 0] + 0.5) * s.resolution_m
        return float(np.hypot(x - x_m, y - y_m).min())
