"""What the result says of a mission, from messages alone."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from plgrim.evaluation.recorder import MissionRecorder, in_map, quantile
from plgrim.progress import progress_text, stage_table, summary_table, target_text
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.operation import FinishReason, JudgeReport, StageHealth, WorldPicture
from schemas.policy import GlobalPolicy, Plan, SafetyState
from schemas.sensing import Odometry
from schemas.topics import GLOBAL_POLICY, JUDGE, MISSION, ODOMETRY, PLAN, WORLD_PICTURE, health_topic
from tests.runtime.fake_services import mission_state, odometry


def _judge(at_s: int, distance_m: float, lost: bool = False) -> JudgeReport:
    return JudgeReport(
        stamp_ns=at_s * SECOND_NS, world="w", true_pose=Pose(x_m=distance_m), coverage=0.5, covered_area_m2=5,
        reachable_area_m2=10, distance_m=distance_m, contacts=2, lost=lost, lost_reason="fell" if lost else "",
    )  # fmt: skip


def _policy(switched: bool) -> GlobalPolicy:
    return GlobalPolicy(
        stamp_ns=1, irm_version=1, target=3, target_xyz_m=(4.0, 5.0, 0.0), target_gain=1.0, target_q=1.0,
        target_distance_m=6.0, target_risk=0.0, switched=switched, reason="because", alternatives=[],
        map_to_odom=Pose(), node_id=np.zeros(0, np.int64), node_xyz_m=np.zeros((0, 3)),
        action=np.zeros(0, np.int64), value=np.zeros(0), value_to_go=np.zeros(0), path_node=np.zeros(0, np.int64),
        path_xyz_m=np.zeros((0, 3)), path_piece=np.zeros(0, np.int32), route_xyz_m=np.zeros((0, 3)),
    )  # fmt: skip


def _plan(plan_id: int, risk_stamp_s: float) -> Plan:
    none = np.zeros(0)
    return Plan(
        stamp_ns=1, plan_id=plan_id, episode=0, valid=True, safety=SafetyState.RUN, reason="", tau_s=0.0,
        kept_points=0, ttl_s=1.0, risk_stamp_ns=int(risk_stamp_s * SECOND_NS), x_m=none, y_m=none, yaw_rad=none,
        speed_mps=none, time_s=none,
    )  # fmt: skip


def _health(pid: int, errors: int, memory_mb: float) -> StageHealth:
    return StageHealth(
        stamp_ns=1, service="gcp", ready=True, steps=4, step_p50_ms=1.0, step_p99_ms=2.0, rate_hz=1.0,
        memory_mb=memory_mb, pid=pid, errors=errors, last_error="", dropped={"x:bad_checksum": errors},
        waiting_for=[],
    )  # fmt: skip


@pytest.fixture
def recorder() -> MissionRecorder:
    """A mission of 200 m with four switches, in which gcp was restarted once."""
    recorder = MissionRecorder(7, "w", "live", speed=2.0)
    recorder.observe(ODOMETRY, odometry(1, 0.0), 1)
    for distance in (0, 100, 200):
        recorder.observe(JUDGE, _judge(distance, distance), distance * SECOND_NS)
    for switched in (True, False, True, True, True):
        recorder.observe(GLOBAL_POLICY, _policy(switched), 1)
    for epoch, errors, memory in (
        (1, 2, 10.0),
        (1, 3, 30.0),
        (2, 1, 20.0),
    ):  # in containers, all have process id 1
        recorder.observe(health_topic("gcp"), _health(1, errors, memory), 1, epoch)
    for plan_id, (risk_s, sent_s) in enumerate([(1.0, 1.5), (1.0, 9.0), (2.0, 2.25), (3.0, 4.0)], 1):
        recorder.observe(PLAN, _plan(plan_id, risk_s), int(sent_s * SECOND_NS))
    return recorder


def test_a_result_counts_what_happened(recorder: MissionRecorder) -> None:
    recorder.observe(MISSION, mission_state(3, 200, FinishReason.COVERED), 3)
    result = recorder.result()
    assert result["succeeded"] is True
    assert result["finish"] == "covered"
    assert (result["coverage_judge"], result["distance_m"], result["contacts"]) == (0.5, 200, 2)
    assert result["target_switches"] == 4
    assert result["target_switches_per_100m"] == 2.0
    assert result["stages"]["gcp"]["errors"] == 4
    assert result["stages"]["gcp"]["dropped"] == {"x:bad_checksum": 4}
    assert result["stages"]["gcp"]["memory_mb"] == 30.0
    assert (result["seed"], result["world"]) == (7, "w")
    assert "numpy" in result["versions"]


def test_latency_is_from_the_cloud_to_its_first_plan_in_mission_and_wall_time(
    recorder: MissionRecorder,
) -> None:
    latency = recorder.result()["cloud_to_plan"]
    assert latency["plans"] == 3
    assert latency["p50_mission_s"] == pytest.approx(0.5)
    assert latency["p95_wall_s"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("finish", "lost"),
    [(FinishReason.TIME_BUDGET, False), (FinishReason.COVERED, True), (FinishReason.NONE, False)],
)
def test_only_a_covered_world_and_a_whole_robot_are_a_success(
    recorder: MissionRecorder, finish: FinishReason, lost: bool
) -> None:
    recorder.observe(JUDGE, _judge(300, 300, lost), 300 * SECOND_NS)
    recorder.observe(MISSION, mission_state(3, 200, finish), 3)
    assert recorder.result()["succeeded"] is False
    assert recorder.finished == (finish is not FinishReason.NONE)


def test_the_folder_holds_the_track_and_the_pictures(recorder: MissionRecorder, tmp_path: Path) -> None:
    cells = np.arange(12, dtype=np.uint8).reshape(3, 4) % 4
    recorder.observe(WORLD_PICTURE, WorldPicture(stamp_ns=1, resolution_m=0.5, ix0=-1, iy0=0, cell=cells), 1)
    result = recorder.write(tmp_path, {"lcp": [0.001, 0.002, 0.003]}, {"note": "x"})
    assert json.loads((tmp_path / "result.json").read_text(encoding="utf-8")) == result
    assert result["note"] == "x"
    assert result["stages"]["lcp"]["step_p50_ms"] == 2.0
    with (tmp_path / "trajectory.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["true_x_m"]) for row in rows] == [0.0, 100.0, 200.0]
    for name in ("coverage.png", "map.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_an_empty_mission_gives_an_empty_result(tmp_path: Path) -> None:
    result = MissionRecorder(1, "w", "live").write(tmp_path)
    assert result["succeeded"] is False
    assert result["coverage_judge"] is None
    assert summary_table(result).row_count > 5


def test_the_estimated_pose_goes_through_the_odom_frame() -> None:
    pose = in_map(
        Odometry(
            stamp_ns=0,
            pose=Pose(x_m=2.0, yaw_rad=0.5),
            map_to_odom=Pose(x_m=1.0, y_m=1.0, yaw_rad=math.pi / 2),
            speed_mps=0,
            turn_rate_radps=0,
            covariance=np.eye(3),
        )
    )
    assert (pose.x_m, pose.y_m) == pytest.approx((1.0, 3.0))
    assert pose.yaw_rad == pytest.approx(math.pi / 2 + 0.5)


def test_progress_tells_phase_coverage_and_why(recorder: MissionRecorder) -> None:
    recorder.observe(MISSION, mission_state(3, 200, FinishReason.NONE), 3)
    assert "explore" in progress_text(recorder)
    assert "judge 50.0 %" in progress_text(recorder)
    assert "because" in target_text(recorder)
    assert stage_table(recorder.result()).row_count == 1


def test_quantiles_are_by_nearest_rank() -> None:
    assert quantile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert quantile([1.0, 2.0], 0.99) == 2.0
    assert quantile([], 0.5) is None
