"""The sim stage: drives the true robot along the plan and publishes what its sensors, SLAM and judge say.

Without drift `map`, `odom` and the world's frame are one, and SLAM's pose is the true one plus white noise (`slam.py`).
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from planning.frames import Planar, planar
from planning.grid import GridSpec
from planning.randomness import stream
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSetup, StageSpec, Stamp
from schemas.operation import JudgeReport, MissionPhase, WorldPicture
from schemas.policy import Plan
from schemas.sensing import CoverageScan, FollowerState, Odometry, PointCloud, PoseGraph
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import (
    CLOUD,
    COVERAGE_SCAN,
    FOLLOWER,
    JUDGE,
    MISSION,
    ODOMETRY,
    PLAN,
    POSE_GRAPH,
    WORLD_PICTURE,
)
from services.sim.config import SimConfig as Config
from services.sim.coverage import Judge
from services.sim.follower import Command, Follower, TimedPath
from services.sim.follower import FollowerState as FollowerMemory
from services.sim.lidar import Lidar
from services.sim.robot import Robot, RobotState
from services.sim.scene import Scene
from services.sim.slam import Slam
from services.sim.terrain import rotation
from services.sim.world import Door, Mover, World
from services.sim.worlds import build_world

__all__ = ["Config", "SimStage", "create", "spec", "warm_up"]

STEP_NS = SECOND_NS // 20
_SLACK_NS = SECOND_NS // 100
"""A step this much early counts as on time: live timers are not exact."""
_LONGEST_STEP_S = 0.25
"""After a longer pause of the process the robot is taken to have stood still for the rest of it."""
_CONTROL_S = 0.05
"""Longest time between two commands of the follower."""
_POSE_GRAPH_NS, _JUDGE_NS, _PICTURE_NS = 2 * SECOND_NS, SECOND_NS // 2, 10 * SECOND_NS
_PICTURE_CELLS = 1500
"""Most cells along a side of the world's picture."""
_MOST_CERTAIN = 0.999
"""Detection probability is below 1 on the wire: the belief's log odds must stay finite."""
_ENDED = (MissionPhase.DONE, MissionPhase.STOPPED)
_STANDING = Command(0.0, 0.0, 0.0, 0.0, 0.0, False, False, False, False, False)


def spec(config: Config) -> StageSpec:
    """How to run the stage: at 20 Hz."""
    return StageSpec("sim", STEP_NS)


def create(config: Config, setup: StageSetup) -> Stage:
    """A sim stage with the world of its configuration. Raises `WorldError` when there is no such world."""
    return SimStage(config, build_world(config), setup.seed)


class SimStage:
    """One world and one robot in it. Every stream of noise is a function of the seed, its purpose and the tick."""

    def __init__(self, config: Config, world: World, seed: int) -> None:
        self._config, self._world, self._seed = config, world, seed
        self._scene = Scene(world)
        self._robot = Robot(world, config, stream(seed, "sim", "slip"), self._scene)
        self._lidar = Lidar(world, config.lidar, self._scene)
        robot = config.robot
        self._judge = Judge(
            world, robot.footprint_radius_m, config.coverage_sensor, robot, config.lidar.height_m
        )
        self._follower = Follower(config.robot)
        self._command = _STANDING
        self._plan = (0, 0, False)
        """plan_id, stamp and whether it can be driven, of the newest plan."""
        self._estimate = Planar(*world.start)
        self._slam = Slam(config.slam, self._estimate, self._robot.state.z_m, stream(seed, "sim", "drift"))
        self._tick, self._last_ns = 0, -1
        self._distance_m = 0.0
        self._blocked, self._ended, self._told_lost = False, False, False
        self._slots: dict[str, int] = {}
        self.bad_plans = 0
        """Plans that no robot could follow, for instance with times that run backwards: it stopped instead."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Drive until now, then read the newest plan, and publish what is due."""
        noise = stream(self._seed, "sim", "slam", self._tick)
        self._robot.rng = stream(self._seed, "sim", "slip", self._tick)
        self._move_scene(now / SECOND_NS)
        self._drive(now, noise)
        self._read_plan(now, inputs)
        self._estimate = self._noisy_pose(noise)
        self._command = self._follow(now / SECOND_NS)
        changed = self._slam.update(stream(self._seed, "sim", "closure", self._tick))
        found = [Output(ODOMETRY, self._odometry(now)), Output(FOLLOWER, self._follower_state(now))]
        if self._is_due("pose_graph", now, _POSE_GRAPH_NS) or changed:
            found.append(Output(POSE_GRAPH, self._pose_graph(now)))
        if self._is_due("cloud", now, round(SECOND_NS / self._config.lidar.rate_hz)):
            found.append(Output(CLOUD, self._cloud(now)))
        if self._is_due("coverage_scan", now, round(SECOND_NS / self._config.coverage_sensor.rate_hz)):
            self._judge.update(*self._robot.state[:3])
            found.append(Output(COVERAGE_SCAN, self._coverage_scan(now)))
        found += self._judgement(now, inputs)
        self._tick += 1
        return found

    # --- driving ----------------------------------------------------------------------------------------------

    def _drive(self, now: Stamp, noise: np.random.Generator) -> None:
        """Move the true robot from the last step to now; after a late step the follower is asked in between."""
        elapsed_s = min((now - self._last_ns) / SECOND_NS, _LONGEST_STEP_S) if self._last_ns >= 0 else 0.0
        self._last_ns = now
        if elapsed_s <= 0.0:
            return
        drift = stream(self._seed, "sim", "drift", self._tick)
        substeps = math.ceil(elapsed_s / _CONTROL_S - 1e-9)
        duration_s, began_s = elapsed_s / substeps, now / SECOND_NS - elapsed_s
        self._blocked = False
        for k in range(substeps):
            if k > 0:
                self._estimate = self._noisy_pose(noise)
                self._command = self._follow(began_s + k * duration_s)
            before = self._robot.state
            after = self._robot.step(self._command.speed_mps, self._command.turn_rate_radps, duration_s)
            self._distance_m += math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
            self._slam.move(planar(after), after.z_m, drift)
            self._blocked |= after.blocked

    def closed_areas_m(self) -> tuple[tuple[float, float, float, float], ...]:
        """Rectangles (x_low, y_low, x_high, y_high) in `map` that have become solid so far, for who judges runs."""
        return self._scene.closed_areas_m()

    def _move_scene(self, now_s: float) -> None:
        """People walk and doors close."""
        state, radius_m = self._robot.state, self._config.robot.footprint_radius_m
        at = (state.x_m, state.y_m)
        if self._scene.advance(now_s, at, radius_m):
            self._judge.close(self._scene.occupied, at)

    def _follow(self, now_s: float) -> Command:
        return self._follower.step(*self._estimate, now_s, self._blocked)

    def _noisy_pose(self, noise: np.random.Generator) -> Planar:
        """SLAM's pose of base_link in `odom`, which the follower steers by."""
        return self._slam.look(noise)

    def _read_plan(self, now: Stamp, inputs: Inputs) -> None:
        """Follow a new plan; the same one sent again only lives longer."""
        received = inputs.latest(PLAN)
        if received is None:
            return
        plan = received.message
        old_id, old_stamp_ns, was_driven = self._plan
        driven = plan.valid and plan.x_m.size > 0
        same = plan.plan_id == old_id and driven == was_driven
        if same and plan.stamp_ns == old_stamp_ns:
            return
        self._plan = (plan.plan_id, plan.stamp_ns, driven)
        issued_s = min(plan.stamp_ns, now) / SECOND_NS
        if not same:
            self._follower.set_path(self._timed_path(plan, issued_s) if driven else None)
        elif self._follower.path is not None:
            self._follower.refresh(issued_s, plan.ttl_s)

    def _timed_path(self, plan: Plan, issued_s: float) -> TimedPath | None:
        try:
            return TimedPath(
                plan.x_m, plan.y_m, plan.yaw_rad, plan.speed_mps, plan.time_s, issued_s, plan.ttl_s
            )
        except ValueError:
            self.bad_plans += 1
            return None

    # --- messages ---------------------------------------------------------------------------------------------

    def _is_due(self, what: str, now: Stamp, period_ns: int) -> bool:
        """Whether a new period of the mission clock has begun since it was last due. Takes it as done."""
        slot = (now + _SLACK_NS) // period_ns
        if slot <= self._slots.get(what, -1):
            return False
        self._slots[what] = slot
        return True

    def _pose(self, above_m: float = 0.0) -> Pose:
        """The estimated pose, so far along the body's up axis; height and attitude are the true ones."""
        state, at = self._robot.state, self._estimate
        up = rotation(state.roll_rad, state.pitch_rad, at.yaw_rad)[:, 2] * above_m
        return Pose(
            x_m=at.x_m + float(up[0]),
            y_m=at.y_m + float(up[1]),
            z_m=state.z_m + float(up[2]),
            yaw_rad=at.yaw_rad,
            roll_rad=state.roll_rad,
            pitch_rad=state.pitch_rad,
        )

    def _odometry(self, now: Stamp) -> Odometry:
        state, frame = self._robot.state, self._slam.map_to_odom
        return Odometry(
            stamp_ns=now,
            pose=self._pose(),
            map_to_odom=Pose(x_m=frame.x_m, y_m=frame.y_m, yaw_rad=frame.yaw_rad),
            speed_mps=state.speed_mps,
            turn_rate_radps=state.turn_rate_radps,
            covariance=np.diag(self._slam.variances()),
        )

    def _follower_state(self, now: Stamp) -> FollowerState:
        return FollowerState(
            stamp_ns=now,
            plan_id=self._plan[0],
            progress_m=self._command.progress_m,
            tracking_error_m=self._command.tracking_error_m,
            stuck=self._command.stuck,
            blocked=self._blocked,
            contacts=self._robot.state.contacts,
        )

    def _cloud(self, now: Stamp) -> PointCloud:
        state, lidar = self._robot.state, self._config.lidar
        noise = stream(self._seed, "sim", "lidar", self._tick)
        points_m = self._lidar.scan(*state[:3], noise, state.z_m, state.roll_rad, state.pitch_rad)
        return PointCloud(
            stamp_ns=now,
            sensor_in_odom=self._pose(lidar.height_m),
            sensor_in_base=Pose(z_m=lidar.height_m),
            ground_z_m=state.z_m,
            range_m=lidar.range_m,
            points_m=points_m,
        )

    def _coverage_scan(self, now: Stamp) -> CoverageScan:
        nearest, inside = self._slam.nearest()
        sensor = self._config.coverage_sensor
        return CoverageScan(
            stamp_ns=now,
            keyframe_id=nearest,
            pose_in_odom=self._pose().model_copy(
                update={"z_m": self._robot.state.z_m + self._config.lidar.height_m}
            ),
            pose_in_keyframe=Pose(x_m=inside.x_m, y_m=inside.y_m, yaw_rad=inside.yaw_rad),
            range_m=sensor.range_m,
            fov_rad=math.radians(sensor.fov_deg),
            detection_probability=min(sensor.detection_probability, _MOST_CERTAIN),
        )

    def _pose_graph(self, now: Stamp) -> PoseGraph:
        keyframes = self._slam.keyframes
        return PoseGraph(
            stamp_ns=now,
            revision=self._slam.revision,
            keyframe_id=np.arange(len(keyframes)),
            pose_in_map=keyframes,
            covariance=self._slam.keyframe_variances(),
        )

    # --- the judge --------------------------------------------------------------------------------------------

    def _judgement(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Report and picture at their periods; both at once when the mission ends, the report when it is lost."""
        mission = inputs.latest(MISSION)
        ended = mission is not None and mission.message.phase in _ENDED
        ends, self._ended = ended and not self._ended, ended
        lost = self._robot.state.lost
        loses, self._told_lost = lost and not self._told_lost, lost
        found: Outputs = []
        if self._is_due("judge", now, _JUDGE_NS) or ends or loses:
            found.append(Output(JUDGE, self._report(now)))
        if self._is_due("world_picture", now, _PICTURE_NS) or ends:
            found.append(Output(WORLD_PICTURE, world_picture(self._judge, now)))
        return found

    def _report(self, now: Stamp) -> JudgeReport:
        state, judge = self._robot.state, self._judge
        return JudgeReport(
            stamp_ns=now,
            world=self._world.name,
            true_pose=Pose(
                x_m=state.x_m,
                y_m=state.y_m,
                z_m=state.z_m,
                yaw_rad=state.yaw_rad,
                roll_rad=state.roll_rad,
                pitch_rad=state.pitch_rad,
            ),
            coverage=judge.coverage_fraction,
            covered_area_m2=judge.covered_area_m2,
            reachable_area_m2=judge.reachable_area_m2,
            distance_m=self._distance_m,
            contacts=state.contacts,
            lost=state.lost,
            lost_reason=self._robot.lost_reason,
        )

    # --- snapshots --------------------------------------------------------------------------------------------

    def snapshot(self) -> bytes:
        """Robot, follower, judge, keyframes and counters; random streams need nothing but the tick."""
        return pack_snapshot({**self._beside_judge(), "covered": np.packbits(self._judge.covered)})

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot of a stage with the same configuration and seed."""
        state = unpack_snapshot(snapshot)
        self._take_doors(state)
        spec = self._judge.spec
        covered = np.unpackbits(state["covered"], count=spec.width * spec.height).astype(np.bool_)
        self._judge.set_covered(covered.reshape(spec.shape))
        self._set_beside_judge(state)

    def journal(self, outputs: Outputs) -> bytes:
        """All but the judge's cells, and of these the ones covered since the last record.

        The world goes on from what was last judged or mapped (twice a second, and at each keyframe): the true robot
        stands still from there on, and what was covered by the last report stays covered.
        """
        return pack_snapshot({**self._beside_judge(), "new": self._judge.take_news()})

    def replay(self, record: bytes) -> None:
        """Take in a record of the journal."""
        state = unpack_snapshot(record)
        self._take_doors(state)
        self._judge.add_covered(state["new"])
        self._set_beside_judge(state)

    def _beside_judge(self) -> dict[str, Any]:
        path = self._follower.path
        return {
            "robot": list(self._robot.state),
            "path": asdict(path) if path is not None else None,
            "follower": asdict(self._follower.state),
            "command": list(self._command),
            "plan": list(self._plan),
            "estimate": list(self._estimate),
            "closed": self._scene.closed,
            "reachable": np.packbits(self._judge.reachable) if any(self._scene.closed) else None,
            "slam": self._slam.state(),
            "clock": [self._tick, self._last_ns],
            "distance_m": self._distance_m,
            "flags": [self._blocked, self._ended, self._told_lost],
            "slots": self._slots,
            "bad_plans": self.bad_plans,
        }

    def _take_doors(self, state: dict[str, Any]) -> None:
        """Doors that have closed, and what the judge has made of that."""
        if state["reachable"] is None or list(state["closed"]) == list(self._scene.closed):
            return
        self._scene.set_closed(state["closed"])
        spec = self._judge.spec
        reachable = np.unpackbits(state["reachable"], count=spec.width * spec.height).astype(np.bool_)
        self._judge.take_over(self._scene.occupied, reachable.reshape(spec.shape))

    def _set_beside_judge(self, state: dict[str, Any]) -> None:
        self._robot.state = RobotState(*state["robot"])
        self._follower.set_path(TimedPath(**state["path"]) if state["path"] is not None else None)
        memory = state["follower"]
        anchor = memory["anchor"]
        self._follower.state = FollowerMemory(
            **{**memory, "anchor": None if anchor is None else tuple(anchor)}
        )
        self._command = Command(*state["command"])
        plan_id, stamp_ns, driven = state["plan"]
        self._plan = (plan_id, stamp_ns, driven)
        self._estimate = Planar(*state["estimate"])
        self._slam.set_state(state["slam"])
        self._tick, self._last_ns = state["clock"]
        self._distance_m = state["distance_m"]
        self._blocked, self._ended, self._told_lost = state["flags"]
        self._slots, self.bad_plans = state["slots"], state["bad_plans"]


def world_picture(judge: Judge, now: Stamp) -> WorldPicture:
    """The judge's cells, joined k x k where there are too many: a joined cell shows the least of its cells.

    So thin walls stay in the picture, and ground counts as covered when all of it is.
    """
    spec = judge.spec
    cell = (~judge.occupied).astype(np.uint8)
    cell[judge.reachable] = 2
    cell[judge.covered] = 3
    joined = max(1, math.ceil(max(spec.shape) / (_PICTURE_CELLS - 1)))
    if joined > 1:
        # Coarse cells lie on multiples of their own size: pad with wall up to them.
        low_x, low_y = spec.ix0 % joined, spec.iy0 % joined
        high_x, high_y = -(low_x + spec.width) % joined, -(low_y + spec.height) % joined
        cell = np.pad(cell, ((low_y, high_y), (low_x, high_x)))
        rows, columns = cell.shape[0] // joined, cell.shape[1] // joined
        cell = cell.reshape(rows, joined, columns, joined).min(axis=(1, 3))
    return WorldPicture(
        stamp_ns=now,
        resolution_m=spec.resolution_m * joined,
        ix0=spec.ix0 // joined,
        iy0=spec.iy0 // joined,
        cell=np.ascontiguousarray(cell),
    )


def warm_up() -> None:
    """Compile the kernels: on flat ground with a person and a door, and on uneven ground."""
    grid = GridSpec(0.1, 0, 0, 40, 40)
    solid = np.zeros(grid.shape, dtype=np.bool_)
    people, doors = (Mover((1.0, 1.0), (1.0, 3.0), 0.5),), (Door((3.0, 0.0, 3.1, 1.0), 0.1),)
    flat = World("warm-up", grid, solid, (2.0, 2.0, 0.0), movers=people, doors=doors)
    level = np.zeros(grid.shape, np.float32)
    for world in (flat, World("warm-up", grid, solid, (2.0, 2.0, 0.0), level, level + np.float32(3.0))):
        stage = SimStage(Config(), world, 0)
        for k in range(4):
            stage.step(k * STEP_NS, Inputs({}))
