"""The status core: readiness, report, map canvas and picture."""

from __future__ import annotations

import io
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from planning.grid import GridSpec
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.operation import JudgeReport, StageHealth
from schemas.policy import GlobalPolicy
from schemas.sensing import Odometry
from schemas.topics import health_topic, read_by, topic_named
from schemas.world import CoverageWindow, GlobalIrm, GridHeader
from services.status.canvas import TILE, TileCanvas
from services.status.config import Config
from services.status.core import StatusCore
from services.status.picture import Picture, render_png
from tests.schemas.examples import example


def core(**config: Any) -> StatusCore:
    return StatusCore(Config.model_validate(config), "husky1")


def health(service: str, **changes: Any) -> StageHealth:
    values: dict[str, Any] = {
        "stamp_ns": 0,
        "service": service,
        "ready": True,
        "steps": 5,
        "step_p50_ms": 1.5,
        "step_p99_ms": 4.0,
        "rate_hz": 2.0,
        "memory_mb": 80.0,
        "pid": 42,
        "errors": 0,
        "last_error": "",
        "dropped": {},
        "waiting_for": [],
    }
    return StageHealth(**{**values, **changes})


def odometry(x_m: float, y_m: float = 0.0, map_to_odom: Pose | None = None) -> Odometry:
    return Odometry(
        stamp_ns=0,
        pose=Pose(x_m=x_m, y_m=y_m),
        map_to_odom=map_to_odom or Pose(),
        speed_mps=0.5,
        turn_rate_radps=0.0,
        covariance=np.zeros((3, 3)),
    )


def window(ix0: int, iy0: int, cell: np.ndarray[Any, Any], resolution_m: float = 0.2) -> CoverageWindow:
    height, width = cell.shape
    grid = GridHeader(resolution_m=resolution_m, ix0=ix0, iy0=iy0, width=width, height=height)
    return CoverageWindow(stamp_ns=0, grid=grid, cell=cell.astype(np.uint8))


def fill(status: StatusCore, now_ns: int) -> None:
    """One example of every topic that the status service reads."""
    for topic in read_by("status"):
        message = example(topic.message)
        if topic.name.endswith("/health"):
            message = health(topic.writer)
        status.observe(topic.name, message, now_ns)


def test_reasons_before_anything_came() -> None:
    reasons = core().not_ready(0)
    assert "gcp: not heard of yet" in reasons
    assert "sim/odometry: nothing received yet" in reasons
    report = core().status(0)
    assert not report.ready
    assert (report.mission, report.pose, report.coverage, report.target, report.plan) == (None,) * 5
    assert {stage.state for stage in report.stages} == {"missing"}


def test_ready_when_all_is_there_and_fresh() -> None:
    status = core()
    fill(status, 10 * SECOND_NS)
    assert status.not_ready(10 * SECOND_NS) == []
    assert status.status(10 * SECOND_NS).ready


def test_silent_services_and_stale_topics_are_named() -> None:
    status = core()
    fill(status, 0)
    late_ns = health_topic("gcp").stale_after_ns + SECOND_NS
    for topic in read_by("status"):
        if topic.name != "gcp/health" and topic.name != "irm/local_irm":
            message = health(topic.writer) if topic.name.endswith("/health") else example(topic.message)
            status.observe(topic.name, message, late_ns)
    assert status.not_ready(late_ns) == ["gcp: silent for 4.0 s", "irm/local_irm: nothing for 4.0 s"]


def test_services_that_are_not_ready_say_what_they_wait_for() -> None:
    status = core()
    fill(status, 0)
    status.observe("lcp/health", health("lcp", ready=False, waiting_for=["irm/local_irm"]), 0)
    assert status.not_ready(0) == ["lcp: not ready, waiting for irm/local_irm"]


def test_a_real_robot_has_no_sim() -> None:
    status = core(expected_services=["gcp"], expected_topics=[])
    status.observe("gcp/health", health("gcp"), 0)
    assert status.not_ready(0) == []
    assert [stage.service for stage in status.status(0).stages] == ["gcp"]


def test_report_of_a_stage() -> None:
    status = core()
    dropped = {"sim/odometry:bad_checksum": 3}
    status.observe("gcp/health", health("gcp", errors=2, last_error="boom", dropped=dropped), 0)
    stage = next(s for s in status.status(2 * SECOND_NS).stages if s.service == "gcp")
    assert (stage.state, stage.age_s, stage.errors, stage.last_error) == ("ok", 2.0, 2, "boom")
    assert (stage.rate_hz, stage.step_p50_ms, stage.step_p99_ms, stage.memory_mb) == (2.0, 1.5, 4.0, 80.0)
    assert stage.dropped == dropped


def test_report_of_the_mission() -> None:
    status = core()
    fill(status, 0)
    report = status.status(SECOND_NS)
    assert report.mission is not None
    assert report.mission.phase == "done"
    assert report.coverage is not None
    assert report.coverage.belief == pytest.approx(0.75)
    assert report.coverage.judge == pytest.approx(0.75)
    assert report.target is not None
    assert report.target.reason == "text"
    assert report.plan is not None
    assert (report.plan.safety, report.plan.age_s) == ("done", 1.0)
    assert report.lost is True


def test_judge_is_unknown_on_a_real_robot() -> None:
    status = core()
    for topic in read_by("status"):
        if topic.message not in (JudgeReport, StageHealth):
            status.observe(topic.name, example(topic.message), 0)
    report = status.status(0)
    assert report.coverage is not None
    assert report.coverage.judge is None
    assert report.lost is None


def test_pose_is_in_the_map() -> None:
    status = core()
    status.observe("sim/odometry", odometry(2.0, 0.0, Pose(x_m=1.0, yaw_rad=np.pi / 2)), 0)
    pose = status.status(0).pose
    assert pose is not None
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((1.0, 2.0, np.pi / 2))


def test_rates_and_ages_of_topics() -> None:
    status = core()
    for tick in range(20):
        status.observe("sim/odometry", odometry(0.0), tick * SECOND_NS // 10)
    (topic,) = status.status(2 * SECOND_NS).topics
    assert topic.rate_hz == pytest.approx(10.0)
    assert topic.age_s == pytest.approx(0.1)
    assert topic.messages == 20
    assert not topic.stale
    (topic,) = status.status(12 * SECOND_NS).topics
    assert topic.rate_hz < 0.1  # a topic that has stopped has no rate
    assert topic.stale


def test_target_switches_are_counted() -> None:
    status = core()
    policy: GlobalPolicy = example(GlobalPolicy)
    for switched in (True, False, True):
        status.observe("gcp/global_policy", policy.model_copy(update={"switched": switched}), 0)
    assert status.status(0).target_switches == 2


def test_trajectory_is_thinned() -> None:
    status = core(trajectory_spacing_m=0.5, max_trajectory_points=20)
    for step in range(400):
        status.observe("sim/odometry", odometry(0.1 * step), 0)
    points = status.picture().trajectory
    assert 10 <= len(points) <= 20
    assert points[0] == (0.0, 0.0)
    assert all(b[0] > a[0] for a, b in pairwise(points))


def test_asks_for_the_graph_when_a_difference_was_missed() -> None:
    status = core(ask_again_s=5.0)
    graph: GlobalIrm = example(GlobalIrm)
    assert status.graph_request(0, 0) is None
    status.observe("irm/global_irm", graph.model_copy(update={"base_version": 9}), 0)
    assert status.graph_request(0, 0) is not None
    assert status.graph_request(4 * SECOND_NS, 0) is None
    assert status.graph_request(5 * SECOND_NS, 0) is not None
    whole = {
        "base_version": 0,
        "node_id": np.array([1, 2, 3]),
        "node_kind": np.array([0, 1, 1], np.uint8),
        "edge_a": np.array([1, 1]),
        "edge_b": np.array([2, 3]),
        "edge_distance_m": np.ones(2),
        "edge_risk": np.zeros(2),
        "edge_driven": np.zeros(2, np.uint8),
    }
    status.observe("irm/global_irm", graph.model_copy(update=whole), 0)
    assert status.graph_request(20 * SECOND_NS, 0) is None
    assert len(status.picture().frontiers) == 2


def test_numbers_have_only_what_is_known() -> None:
    status = core()
    assert dict(status.numbers(0)) == {"ready": 0.0, "target_switches": 0.0, "events_total": 0.0}
    fill(status, 0)
    assert status.numbers(0)["coverage_belief"] == pytest.approx(0.75)


@given(
    st.lists(
        st.tuples(st.integers(-600, 600), st.integers(-600, 600), st.integers(0, 2**32 - 1)),
        min_size=1,
        max_size=6,
    )
)
def test_canvas_equals_one_large_array(windows: list[tuple[int, int, int]]) -> None:
    canvas, plain = TileCanvas(), np.zeros((1400, 1400), np.uint8)
    for ix0, iy0, seed in windows:
        cells = np.random.default_rng(seed).integers(0, 5, (60, 90)).astype(np.uint8)
        canvas.paste(GridSpec(0.2, ix0, iy0, 90, 60), cells)
        inside = plain[iy0 + 650 : iy0 + 710, ix0 + 650 : ix0 + 740]
        inside[cells != 0] = cells[cells != 0]
    whole = canvas.whole()
    assert whole is not None
    spec, cells = whole
    rows, columns = np.nonzero(plain)
    assert (spec.ix0, spec.iy0) == (columns.min() - 650, rows.min() - 650)
    assert np.array_equal(cells, plain[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1])


def test_canvas_keeps_what_was_known_and_starts_anew_at_another_resolution() -> None:
    canvas = TileCanvas()
    assert canvas.whole() is None
    canvas.paste(GridSpec(0.2, -3, TILE - 2, 6, 4), np.full((4, 6), 2, np.uint8))
    canvas.paste(GridSpec(0.2, -3, TILE - 2, 6, 4), np.zeros((4, 6), np.uint8))
    whole = canvas.whole()
    assert whole is not None
    assert whole[0] == GridSpec(0.2, -3, TILE - 2, 6, 4)
    assert (whole[1] == 2).all()
    canvas.paste(GridSpec(0.1, 0, 0, 2, 2), np.ones((2, 2), np.uint8))
    whole = canvas.whole()
    assert whole is not None
    assert whole[0] == GridSpec(0.1, 0, 0, 2, 2)


def image_of(png: bytes) -> Image.Image:
    return Image.open(io.BytesIO(png)).convert("RGB")


def test_placeholder_before_any_data() -> None:
    image = image_of(render_png(core().picture(), 1000))
    assert image.size == (480, 240)
    assert len(set(image.get_flattened_data())) > 1  # there is writing on it


def test_picture_has_north_up_and_east_right() -> None:
    """One covered cell to the lower left, one obstacle to the upper right."""
    cell = np.array([[2, 1], [1, 3]])
    status = core()
    status.observe("irm/coverage_window", window(0, 0, cell), 0)
    image = image_of(render_png(status.picture(), 100))
    lower_left, upper_right = (8 + 25, 8 + 18 + 75), (8 + 75, 8 + 18 + 25)
    assert image.getpixel(lower_left) == (146, 205, 160)
    assert image.getpixel(upper_right) == (45, 52, 64)


def test_robot_and_target_are_drawn_where_they_are() -> None:
    canvas = (GridSpec(1.0, 0, 0, 10, 10), np.full((10, 10), 2, np.uint8))
    image = image_of(render_png(Picture(canvas, robot=(2.5, 7.5, 0.0)), 100))
    assert image.getpixel((8 + 25, 8 + 18 + 25)) == (178, 24, 43)
    assert image.getpixel((8 + 75, 8 + 18 + 75)) == (146, 205, 160)


def test_picture_is_limited_in_size() -> None:
    canvas = (GridSpec(0.2, 0, 0, 3000, 10), np.full((10, 3000), 1, np.uint8))
    assert image_of(render_png(Picture(canvas), 500)).size[0] == 500 + 16


def test_every_topic_read_is_known_by_name() -> None:
    for name in Config().expected_topics:
        assert "status" in topic_named(name).readers


def test_a_robot_of_which_nothing_comes_any_more_is_told_apart_from_a_stale_topic() -> None:
    status = core()
    assert status.status(0).silent_s is None  # never heard of
    fill(status, 0)
    status.observe("sim/odometry", odometry(0.0), 20 * SECOND_NS)
    assert status.status(20 * SECOND_NS).silent_s is None  # much is stale, but the robot speaks
    # The base's own planners go on over a cut link.
    status.observe("gcp/health", health("gcp"), 29 * SECOND_NS)
    status.observe("gcp/global_policy", example(GlobalPolicy), 29 * SECOND_NS)
    assert status.status(30 * SECOND_NS).silent_s == pytest.approx(10.0)
    status.observe("sim/odometry", odometry(0.0), 31 * SECOND_NS)
    assert status.status(31 * SECOND_NS).silent_s is None
