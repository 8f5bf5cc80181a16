"""A real mission stage behind the status service's desk, in this process: commands are answered as on the robot."""

from __future__ import annotations

import threading

from schemas.base import Message
from schemas.contract import SECOND_NS, Inputs, Outputs, Received, Topic
from schemas.operation import MissionCommand
from schemas.topics import COMMAND, ODOMETRY
from services.mission.stage import Config as MissionConfig
from services.mission.stage import MissionStage
from services.status.app import SharedStatus
from tests.mission.test_stage import odometry


class MissionBehind:
    """Steps the stage with each command, and shows its messages to the status."""

    def __init__(self, shared: SharedStatus, config: MissionConfig | None = None) -> None:
        self.stage = MissionStage(config or MissionConfig())
        self.carried_out: list[str] = []
        self.x_m = 0.0
        self._shared = shared
        self._now = 0
        self._lock = threading.Lock()
        shared.desk.send = self.send
        self._step([(ODOMETRY, odometry(self.x_m))])

    def send(self, command: MissionCommand) -> None:
        """A command comes."""
        self.carried_out.append(command.command_id)
        self._step([(ODOMETRY, odometry(self.x_m)), (COMMAND, command)])

    def _step(self, given: list[tuple[Topic[Message], Message]]) -> None:
        with self._lock:
            self._now += SECOND_NS
            messages = {
                topic.name: [Received(message, topic.writer, 1, 1, self._now, 0, fresh=True, stale=False)]
                for topic, message in given
            }
            found: Outputs = self.stage.step(self._now, Inputs(messages))
        for output in found:
            self._shared.observe(output.topic.name, output.message)
