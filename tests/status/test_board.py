"""The live state in parts: packed once, told once, told again to who was away."""

from __future__ import annotations

import zlib
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planning.graph_mirror import GraphMirror
from services.status.app import LiveStatus, SharedStatus
from services.status.board import Board
from services.status.config import Config
from services.status.parts import CHUNK_IDS, graph_parts, risk_code
from tests.status.scene import Scene, graph, health, plan


def read(frame: bytes) -> dict[str, Any]:
    found: dict[str, Any] = msgpack.unpackb(frame)
    return found


def test_a_frame_holds_what_changed_since() -> None:
    board = Board()
    board.put("a", {"x": 1})
    board.put("b", 2)
    seen = board.version
    board.put("b", 3)
    board.put("a", {"x": 1})  # as it was
    assert read(board.frame(0)) == {
        "boot": board.boot,
        "version": board.version,
        "full": True,
        "parts": {"a": {"x": 1}, "b": 3},
    }
    assert read(board.frame(seen))["parts"] == {"b": 3}
    assert read(board.frame(board.version))["parts"] == {}


def test_many_changes_are_told_as_the_last_one() -> None:
    board = Board()
    board.put("a", 0)
    seen, few = board.version, len(board.frame(0))
    for n in range(1000):
        board.put("a", n % 100)
    assert read(board.frame(seen))["parts"] == {"a": 99}
    assert len(board.frame(seen)) < few + 10


def test_a_part_that_is_gone_is_told_to_those_who_have_it() -> None:
    board = Board()
    board.put("graph:0", 1)
    board.put("graph:1", 1)
    seen = board.version
    board.keep_only("graph:", {"graph:1"})
    assert read(board.frame(seen))["parts"] == {"graph:0": None}
    assert read(board.frame(0))["parts"] == {"graph:1": 1}


def test_browsers_that_are_as_far_get_the_same_bytes() -> None:
    board = Board()
    board.put("a", 1)
    assert board.frame(0) is board.frame(0)


def test_the_risk_code_tells_unknown_lethal_and_the_order_of_hazards() -> None:
    state = np.array([[0, 2, 1, 1, 1, 1]], np.uint8)
    hazard = np.array([[9, 0, 0, 0.001, 0.5, 50]], np.float32)
    code = risk_code(state, hazard)[0].tolist()
    assert code[:2] == [0, 255]
    assert 1 <= code[2] < code[3] < code[4] < code[5] == 254


def test_one_new_node_changes_one_part_of_the_graph() -> None:
    mirror = GraphMirror()
    whole = graph(40)
    assert mirror.apply(whole)
    before = graph_parts(mirror.road_map())
    assert sum(len(part["id"]) // 4 for part in before.values()) == 1600
    assert sum(len(part["a"]) // 4 for part in before.values()) == whole.edge_a.size
    empty = np.empty(0)
    update = whole.model_copy(
        update={
            "irm_version": 2, "base_version": 1, "node_id": np.array([1600]), "node_kind": np.ones(1, np.uint8),
            "node_xyz_m": np.zeros((1, 3)), "node_gain": np.ones(1), "node_coverage": np.ones(1, np.float32),
            "edge_a": np.array([1599]), "edge_b": np.array([1600]), "edge_distance_m": np.ones(1),
            "edge_risk": np.zeros(1), "edge_driven": np.zeros(1, np.uint8), "removed_node": empty.astype(np.int64),
        }
    )  # fmt: skip
    assert mirror.apply(update)
    after = graph_parts(mirror.road_map())
    assert [n for n in after if after[n] != before.get(n)] == [1600 // CHUNK_IDS]


@pytest.fixture
def scene() -> Scene:
    return Scene(SharedStatus(Config(), "husky1"), risk_cells=100, graph_side=40)


def test_a_drawing_holds_everything_that_the_page_shows(scene: Scene) -> None:
    live = LiveStatus(scene.shared)
    for _ in range(60):
        scene.step()
    live.tick()
    parts = read(live.board.frame(0))["parts"]
    words = {key.split(":")[0] for key in parts}
    assert words >= {
        "pose", "risk", "local", "plan", "graph", "policy", "cov", "trail", "status", "curve", "steps", "events",
    }  # fmt: skip
    assert len(zlib.decompress(parts["risk"]["cells_z"])) == 100 * 100
    assert parts["plan"]["kept"] == 8
    assert len(parts["plan"]["old"]) > 0, "the path before the turn at step 50"
    assert parts["pose"]["cov"] == pytest.approx([0.09, 0.03, 0.0225])


def test_a_drawing_of_an_unchanged_state_draws_nothing_but_ages(scene: Scene) -> None:
    live = LiveStatus(scene.shared)
    scene.step()
    live.tick()
    seen = live.board.version
    live.tick()
    assert set(read(live.board.frame(seen))["parts"]) <= {"status"}


def test_restarts_and_step_times_outlive_a_restart_of_the_status(scene: Scene) -> None:
    for _ in range(60):
        scene.step()
    scene.shared.observe("gcp/health", health("gcp", pid=8))
    fresh = SharedStatus(Config(), "husky1")
    fresh.restore(scene.shared.snapshot())
    slow = fresh.read(lambda core, now_ns: core.view(now_ns, 0, True)).slow
    assert slow is not None
    assert slow.restarts == {"gcp": 1}
    assert len(slow.step_times) == 3  # 0, 2 and 4 s of mission time
    assert slow.events


def test_the_old_path_is_the_one_before_the_policy_changed() -> None:
    scene = Scene(SharedStatus(Config(), "husky1"))
    for n in (40, 48, 50):
        scene.shared.observe("reconciler/plan", plan(n))
    view = scene.shared.read(lambda core, now_ns: core.view(now_ns, 0, False))
    assert view.old_path[0] == pytest.approx((plan(48).x_m[0], plan(48).y_m[0]))


def _take(shown: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """What the page does with a frame (`store.js`)."""
    kept = {} if frame["full"] else shown
    return {key: value for key, value in (kept | frame["parts"]).items() if value is not None}


@given(st.lists(st.tuples(st.integers(0, 11), st.sampled_from(["put", "drop", "look"])), max_size=120))
def test_a_browser_that_looks_now_and_then_shows_what_is_there_whatever_was_forgotten(
    steps: list[tuple[int, str]],
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("services.status.board._KEPT_GONE", 3)
        board, there, shown, version = Board(), dict[str, Any](), dict[str, Any](), 0
        for n, (part, what) in enumerate([*steps, (0, "look")]):
            if what == "put":
                there[f"p:{part}"] = n
                board.put(f"p:{part}", n)
            elif what == "drop":
                there.pop(f"p:{part}", None)
                board.keep_only("p:", set(there))
            else:
                frame = read(board.frame(version))
                shown, version = _take(shown, frame), frame["version"]
                assert shown == there


def test_parts_that_come_and_go_leave_nothing_behind() -> None:
    board = Board()
    for n in range(5000):
        board.put(f"events:{n}", n)
        board.keep_only("events:", {f"events:{n}"})
    assert len(board._parts) < 300
    assert read(board.frame(1))["full"]
    assert not read(board.frame(board.version - 10))["full"]
