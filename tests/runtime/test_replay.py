"""A snapshot and the records after it lead to the state that the outputs told of, for every stage that journals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from planning.graph_mirror import GraphMirror
from plgrim.registry import STAGES, make_stage
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Pose
from schemas.contract import (
    SECOND_NS,
    Inputs,
    Journaling,
    Outputs,
    Received,
    Resuming,
    Stage,
    StageSetup,
    Stamp,
)
from schemas.sensing import Odometry
from schemas.snapshot import unpack_snapshot
from schemas.topics import GLOBAL_IRM, LOCAL_IRM, ODOMETRY, TOPICS
from schemas.world import GlobalIrm

OPTIONS: dict[str, dict[str, Any]] = {
    "sim": {"world": "subway_1x", "seed": 3},
    "reconciler": {"simulations": 256},
}
SNAPSHOT_S, END_S = 8, 24


class Watched:
    """Steps a stage as the live driver does, and keeps what that would have written and said."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.snapshot_at_start: bytes | None = None
        self.records: list[bytes] = []
        self.published: list[Outputs] = []
        self.at_last_record = b""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One step, and its record."""
        found = self.stage.step(now, inputs)
        if self.snapshot_at_start is None and now >= SNAPSHOT_S * SECOND_NS:
            self.snapshot_at_start = self.stage.snapshot()
        elif self.snapshot_at_start is not None and any(output.topic.journaled for output in found):
            assert isinstance(self.stage, Journaling)
            self.records.append(self.stage.journal(found))
            self.at_last_record = self.stage.snapshot()
        self.published.append(found)
        return found

    def snapshot(self) -> bytes:
        """Of the stage."""
        return self.stage.snapshot()

    def restore(self, snapshot: bytes) -> None:
        """Of the stage."""
        self.stage.restore(snapshot)


@pytest.fixture(scope="module")
def watched() -> dict[str, Watched]:
    """All stages after a mission of some seconds."""
    run = Lockstep(OPTIONS, seed=3)
    found = {}
    for name, runner in run._runners.items():
        found[name] = Watched(runner.stage)
        runner.stage = found[name]
    run.run_until(END_S * SECOND_NS)
    return found


def _twin(name: str, watched: Watched) -> Stage:
    """A new stage that has taken in the snapshot and the records."""
    _, twin = make_stage(name, OPTIONS.get(name, {}), StageSetup("robot", 3))
    assert watched.snapshot_at_start is not None
    twin.restore(watched.snapshot_at_start)
    assert isinstance(twin, Journaling)
    for record in watched.records:
        twin.replay(record)
    return twin


COMES_AGAIN = {
    "irm": {"keyframes", "pending", "anchors"},
    "gcp": {"graph", "asked_ns"},
    "mission": {"graph"},
    "sim": set[str](),
}
"""Of each snapshot what other services tell again, or what is found anew in the next step."""


def test_every_journaled_topic_belongs_to_a_stage_that_journals(watched: dict[str, Watched]) -> None:
    writers = {topic.writer for topic in TOPICS if topic.journaled}
    assert writers == set(COMES_AGAIN)
    for name in STAGES:
        assert isinstance(watched[name].stage, Journaling) == (name in writers)


@pytest.mark.parametrize("name", sorted(COMES_AGAIN))
def test_snapshot_and_records_lead_to_the_state_at_the_last_record(
    watched: dict[str, Watched], name: str
) -> None:
    one = watched[name]
    assert len(one.records) > 5
    expected, found = unpack_snapshot(one.at_last_record), unpack_snapshot(_twin(name, one).snapshot())
    assert expected.keys() == found.keys()
    assert one.snapshot_at_start is not None
    assert _plain(unpack_snapshot(one.snapshot_at_start)) != _plain(expected)
    for key in sorted(expected.keys() - COMES_AGAIN[name]):
        assert _plain(found[key]) == _plain(expected[key]), key


def _plain(value: Any) -> Any:
    """The value without arrays, to compare."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in sorted(value.items(), key=lambda item: str(item[0]))}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value


def _odometry(stamp_ns: int) -> Inputs:
    odometry = Odometry(
        stamp_ns=stamp_ns,
        pose=Pose(),
        map_to_odom=Pose(),
        speed_mps=0.0,
        turn_rate_radps=0.0,
        covariance=np.eye(3),
    )
    return Inputs({ODOMETRY.name: [Received(odometry, "sim", 1, 1, stamp_ns, 0, True, False)]})


def test_a_resumed_irm_first_says_the_graph_that_was_acknowledged(watched: dict[str, Watched]) -> None:
    acknowledged = GraphMirror()
    newest = 0
    for found in watched["irm"].published:
        for output in found:
            if isinstance(output.message, GlobalIrm):
                assert acknowledged.apply(output.message)
            elif output.topic.name == LOCAL_IRM.name:
                newest = output.message.irm_version  # type: ignore[attr-defined]
    twin = _twin("irm", watched["irm"])
    assert isinstance(twin, Resuming)
    twin.resumed()
    (first,) = twin.step(END_S * SECOND_NS, _odometry(END_S * SECOND_NS))
    assert first.topic.name == GLOBAL_IRM.name
    assert isinstance(first.message, GlobalIrm)
    assert first.message.base_version == 0
    assert first.message.irm_version == acknowledged.version + 1
    again = GraphMirror()
    assert again.apply(first.message)
    assert _plain(again.snapshot()["columns"]) == _plain(acknowledged.snapshot()["columns"])
    assert again.road_map().node_id.size > 5
    assert unpack_snapshot(twin.snapshot())["version"] > newest
