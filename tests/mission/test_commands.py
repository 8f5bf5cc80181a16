"""Commands to the mission: answered once and alike, fences kept and told, budgets changed."""

from __future__ import annotations

from typing import Any

import pytest

from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Inputs, Output, Received
from schemas.fences import Fence, FenceFrame, FenceKind, Fences, Ring
from schemas.operation import CommandAnswer, CommandKind, MissionCommand, MissionPhase, MissionState
from schemas.topics import COMMAND, ODOMETRY
from services.mission.stage import Config, MissionStage
from tests.mission.test_stage import odometry

BOX = [(2.0, -1.0), (5.0, -1.0), (5.0, 1.0), (2.0, 1.0), (2.0, -1.0)]


def fence(points: list[tuple[float, float]] = BOX, kind: FenceKind = FenceKind.NO_GO, **more: Any) -> Fence:
    values: dict[str, Any] = {"kind": kind, "frame": FenceFrame.MAP, "rings": [Ring.of(points)], **more}
    return Fence(**values)


class Bench:
    """A mission whose robot stands at a place."""

    def __init__(self, x_m: float = 0.0, frame: Pose | None = None, **config: Any) -> None:
        self.stage = MissionStage(Config.model_validate(config))
        self.now, self.x_m, self.frame = 0, x_m, frame
        self.state: MissionState | None = None
        self.told: list[Fences] = []
        self.outputs: list[Output] = []
        self.step()

    def step(self, *commands: MissionCommand) -> list[CommandAnswer]:
        self.now += SECOND_NS // 2
        given: list[tuple[Any, Message]] = [(ODOMETRY, odometry(self.x_m, self.frame))]
        given += [(COMMAND, one) for one in commands]
        messages: dict[str, list[Received[Message]]] = {}
        for topic, message in given:
            received = Received(message, topic.writer, 1, 1, self.now, 0, fresh=True, stale=False)
            messages.setdefault(topic.name, []).append(received)
        self.outputs = self.stage.step(self.now, Inputs(messages))
        found = [output.message for output in self.outputs]
        self.told += [m for m in found if isinstance(m, Fences)]
        self.state = next(m for m in found if isinstance(m, MissionState))
        return [m for m in found if isinstance(m, CommandAnswer)]

    def phase(self) -> MissionPhase:
        assert self.state is not None
        return self.state.phase

    def ask(self, kind: CommandKind, name: str = "a", **more: Any) -> CommandAnswer:
        (answer,) = self.step(MissionCommand(stamp_ns=self.now, command_id=name, kind=kind, **more))
        return answer


def test_every_command_is_answered_with_what_happened() -> None:
    bench = Bench()
    paused = bench.ask(CommandKind.PAUSE, "1")
    assert (paused.accepted, paused.phase) == (True, MissionPhase.PAUSED)
    again = bench.ask(CommandKind.PAUSE, "2")
    assert not again.accepted
    assert "nothing to pause" in again.reason
    assert bench.ask(CommandKind.RESUME, "3").phase == MissionPhase.EXPLORE
    assert "started already" in bench.ask(CommandKind.START, "4").reason
    assert bench.ask(CommandKind.HOME, "5").accepted
    bench.x_m = 20.0
    assert not bench.ask(CommandKind.RESUME, "6").accepted


def test_the_same_key_gets_the_same_answer_and_is_carried_out_once() -> None:
    bench = Bench()
    first = bench.ask(CommandKind.FENCE, "k", fences=[fence()])
    assert first.accepted
    assert first.fence_ids == ["no_go-1"]
    assert bench.ask(CommandKind.FENCE, "k", fences=[fence()]) == first
    assert bench.state is not None
    assert bench.state.fences_version == 1
    other = bench.ask(CommandKind.STOP, "k")
    assert not other.accepted
    assert "another command (fence)" in other.reason
    assert bench.state.phase == MissionPhase.EXPLORE


def test_fences_are_told_before_the_state_that_names_them() -> None:
    bench = Bench()
    bench.ask(CommandKind.FENCE, fences=[fence()])
    names = [output.topic.name for output in bench.outputs]
    assert names.index("mission/fences") < names.index("mission/state") < names.index("mission/answer")
    assert bench.told[-1].version == 1
    assert [f.fence_id for f in bench.told[-1].fences] == ["no_go-1"]
    told = len(bench.told)
    for _ in range(8):
        bench.step()
    assert len(bench.told) == told + 2  # every 2 s for those who come late


@pytest.mark.parametrize(
    ("fences", "says"),
    [
        ([], "no polygon"),
        ([fence(BOX[:-1])], r"fences\[0\].rings\[0\]: .*not closed"),
        ([fence(), fence([(0, 9), (4, 13), (4, 9), (0, 13), (0, 9)])], r"fences\[1\].*crosses itself"),
        (
            [fence([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])],
            "robot stands in the no-go polygon 'no_go-1'",
        ),
        ([fence(kind=FenceKind.GEOFENCE)], "robot stands outside the geofence"),
    ],
)
def test_what_cannot_be_obeyed_is_refused_whole(fences: list[Fence], says: str) -> None:
    import re

    bench = Bench()
    answer = bench.ask(CommandKind.FENCE, fences=fences)
    assert not answer.accepted
    assert re.search(says, answer.reason)
    assert bench.state is not None
    assert bench.state.fences_version == 0


def test_frames_are_minded() -> None:
    """The robot is at (1, 0) in `odom` and at (11, 0) in `map`."""
    around = [(0.0, -1.0), (2.0, -1.0), (2.0, 1.0), (0.0, 1.0), (0.0, -1.0)]
    bench = Bench(1.0, Pose(x_m=10.0))
    assert bench.ask(CommandKind.FENCE, "1", fences=[fence(around)]).accepted
    refused = bench.ask(CommandKind.FENCE, "2", fences=[fence(around, frame=FenceFrame.ODOM)])
    assert "robot stands in" in refused.reason


def test_a_geofence_replaces_the_one_before_and_ids_replace() -> None:
    bench = Bench()
    wide = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0), (-9.0, -9.0)]
    bench.ask(CommandKind.FENCE, "1", fences=[fence(wide, FenceKind.GEOFENCE), fence(fence_id="pit")])
    bench.ask(CommandKind.FENCE, "2", fences=[fence(wide, FenceKind.GEOFENCE, name="site")])
    bench.ask(CommandKind.FENCE, "3", fences=[fence(fence_id="pit", name="deep")])
    held = {f.fence_id: f.name for f in bench.told[-1].fences}
    assert held == {"pit": "deep", "geofence-2": "site"}
    unknown = bench.ask(CommandKind.UNFENCE, "4", fence_ids=["pot"])
    assert "no fence 'pot'; there are: pit, geofence-2" in unknown.reason
    assert bench.ask(CommandKind.UNFENCE, "5").fence_ids == ["pit", "geofence-2"]
    assert bench.told[-1].fences == []


def test_home_behind_a_fence_is_said() -> None:
    bench = Bench()
    bench.x_m = 8.0
    bench.step()
    around_home = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)]
    answer = bench.ask(CommandKind.FENCE, fences=[fence(around_home)])
    assert answer.accepted
    assert "home is shut by 'no_go-1'" in answer.reason


def test_the_time_budget_changes_and_a_robot_that_turned_back_goes_on() -> None:
    bench = Bench(time_budget_s=5.0)
    for _ in range(12):
        bench.x_m += 1.0
        bench.step()
    assert bench.phase() == MissionPhase.RETURN
    more = bench.ask(CommandKind.BUDGET, "1", time_budget_s=900.0)
    assert "900 s (was 5 s)" in more.reason
    assert bench.state is not None
    assert bench.state.time_budget_s == 900.0
    assert bench.phase() == MissionPhase.EXPLORE
    bench.ask(CommandKind.BUDGET, "2", time_budget_s=6.0)
    assert bench.phase() == MissionPhase.RETURN


def test_fences_and_answers_survive_a_restart() -> None:
    bench, twin = Bench(), Bench()
    first = bench.ask(CommandKind.FENCE, "k", fences=[fence(name="pit")])
    twin.stage.replay(bench.stage.journal(bench.outputs))
    twin.now = bench.now
    assert twin.ask(CommandKind.FENCE, "k", fences=[fence(name="pit")]) == first
    snapped = Bench()
    snapped.stage.restore(twin.stage.snapshot())
    snapped.now = twin.now
    assert snapped.ask(CommandKind.UNFENCE, "u").fence_ids == ["no_go-1"]
    # A number that was given once is not given again.
    assert snapped.ask(CommandKind.FENCE, "n", fences=[fence()]).fence_ids == ["no_go-2"]
