"""Commands by their id: each carried out once, and answered alike however often it comes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import xxhash

from schemas.contract import Stamp
from schemas.operation import CommandAnswer, MissionCommand, MissionPhase

_REMEMBERED = 256


@dataclass(slots=True)
class OrderBook:
    """The newest answers by command id, each with a digest of the command that it answers."""

    answers: dict[str, tuple[str, CommandAnswer]] = field(default_factory=dict)

    def before(
        self, command: MissionCommand, now: Stamp, phase: MissionPhase, version: int
    ) -> CommandAnswer | None:
        """The answer when this id came before: the same again, or a refusal when the command was another one."""
        held = self.answers.get(command.command_id)
        if held is None:
            return None
        digest, answer = held
        if digest == _digest(command):
            return answer
        return CommandAnswer(
            stamp_ns=now,
            command_id=command.command_id,
            kind=command.kind,
            accepted=False,
            reason=f"command_id: {command.command_id!r} was another command ({answer.kind.value}); take a new one",
            phase=phase,
            fence_ids=[],
            fences_version=version,
        )

    def keep(self, command: MissionCommand, answer: CommandAnswer) -> None:
        """Remember what a command was answered."""
        self.answers[command.command_id] = (_digest(command), answer)
        while len(self.answers) > _REMEMBERED:
            del self.answers[next(iter(self.answers))]

    def state(self) -> list[list[Any]]:
        """For a snapshot."""
        return [[digest, answer.model_dump(mode="json")] for digest, answer in self.answers.values()]

    def set_state(self, state: list[list[Any]]) -> None:
        """From a snapshot."""
        held = [(digest, CommandAnswer.model_validate(answer)) for digest, answer in state]
        self.answers = {answer.command_id: (digest, answer) for digest, answer in held}


def _digest(command: MissionCommand) -> str:
    return xxhash.xxh3_64_hexdigest(command.model_dump_json(exclude={"stamp_ns", "command_id"}).encode())
