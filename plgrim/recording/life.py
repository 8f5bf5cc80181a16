"""One life of one recorded stage, stepped again."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import xxhash

from plgrim.errors import ConfigError
from plgrim.recording.difference import first_difference
from plgrim.recording.errors import RecordingError
from plgrim.registry import stage_module, world_errors
from plgrim.runtime.mailbox import Mailbox, Outbox
from plgrim.runtime.step_log import error_text
from schemas.contract import SECOND_NS, Output, Stage, StageSetup
from schemas.errors import MessageError
from schemas.recording import StageSnapshot, StepRecord
from schemas.snapshot import unpack_snapshot
from schemas.topics import read_by, topic_named

Find = Callable[[str, int, int], bytes | None]
"""The bytes of a recorded message by topic, epoch, sequence."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Where a stage said something else than recorded. field: of the message; empty where whole messages differ."""

    service: str
    step: int
    now_ns: int
    topic: str
    sequence: int
    field: str
    says: str

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {name: getattr(self, name) for name in self.__slots__}

    def __str__(self) -> str:
        at = f"{self.service}, step {self.step} at {self.now_ns / SECOND_NS:.3f} s"
        where = f"{self.topic} #{self.sequence} {self.field}".strip() if self.topic else "step"
        return f"{at}: {where}: {self.says}"


class _Readings:
    """A stopwatch that shows what it showed then. short: it was asked more often than then."""

    def __init__(self) -> None:
        self._left: list[float] = []
        self.short = False

    def load(self, readings: list[float]) -> None:
        """For the next step."""
        self._left = readings[::-1]
        self.short = False

    def __call__(self) -> float:
        """The next reading, s; when there is none left, one after every deadline."""
        if self._left:
            return self._left.pop()
        self.short = True
        return float("inf")


class Life:
    """A stage made again from a snapshot. next_step: the step it is ready for. over: it has said something else."""

    def __init__(
        self, key: tuple[str, int], robot: str, snapshot: StageSnapshot, overrides: Mapping[str, Any]
    ) -> None:
        """overrides: configuration that replaces the recorded one. Raises RecordingError, ConfigError."""
        self.service, epoch = key
        self.next_step = self._first = snapshot.step
        self.over = False
        self._readings = _Readings()
        self._stage = self._make(robot, snapshot, overrides)
        self._mailbox = Mailbox(robot, tuple(read_by(self.service)))
        self._outbox = Outbox(robot, self.service, epoch)
        try:
            state = unpack_snapshot(snapshot.state.tobytes())
            self._stage.restore(state["stage"])
            self._mailbox.set_state(state["mailbox"])
            self._outbox.sequence = Counter(state["sequence"])
        except Exception as error:  # of another version of the program
            raise RecordingError(
                f"{self.service}: the recorded state is not one of this version of the program ({error!r}): "
                "replay with the version that recorded it"
            ) from error

    def _make(self, robot: str, snapshot: StageSnapshot, overrides: Mapping[str, Any]) -> Stage:
        module = stage_module(self.service)
        options = {**json.loads(snapshot.options), **overrides}
        try:
            config = module.Config.model_validate(options)
        except ValueError as error:
            raise ConfigError(f"{self.service}: the recorded configuration does not fit: {error}") from error
        with world_errors(self.service):
            stage: Stage = module.create(config, StageSetup(robot, snapshot.seed, stopwatch=self._readings))
        return stage

    def take_arrivals(self, record: StepRecord, find: Find) -> str:
        """Give the mailbox what came for a step; the name of a message that is missing, or nothing."""
        if record.step == self._first:  # the snapshot's mailbox holds it already
            return ""
        columns = (record.arrived_topic, record.arrived_epoch, record.arrived_sequence, record.arrived_ns)
        for index, epoch, sequence, received_ns in zip(*(c.tolist() for c in columns), strict=True):
            name = record.topics[index]
            payload = find(name, epoch, sequence)
            if payload is None:
                return f"{name} #{sequence}"
            self._mailbox.accept(topic_named(name), payload, received_ns)
        return ""

    def step(self, record: StepRecord, find: Find) -> Difference | None:
        """Step as recorded, and compare."""
        self.next_step = record.step + 1
        inputs = self._mailbox.inputs(record.stamp_ns)
        self._mailbox.stepped()
        self._readings.load(record.stopwatch_s.tolist())
        sent = record.said_ns.tolist()
        said: list[tuple[Output, int, bytes]] = []
        trouble = ""
        try:
            for i, output in enumerate(self._stage.step(record.stamp_ns, inputs)):
                sent_ns = sent[i] if i < len(sent) else record.stamp_ns
                payload = self._outbox.pack(output, sent_ns, inputs.consumed)
                said.append((output, self._outbox.sequence[output.topic.name], payload))
        except Exception as error:
            trouble = error_text(error)
        return self._compare(record, said, trouble, find)

    def _compare(
        self, record: StepRecord, said: list[tuple[Output, int, bytes]], trouble: str, find: Find
    ) -> Difference | None:
        def differs(topic: str, sequence: int, name: str, says: str) -> Difference:
            at = record.stamp_ns
            return Difference(self.service, record.step, at, topic, sequence, name, says)

        if trouble != record.error:
            return differs("", 0, "", f"recorded error {record.error!r}, again {trouble!r}")
        then = [record.topics[i] for i in record.said_topic.tolist()]
        for i, (output, sequence, payload) in enumerate(said[: len(then)]):
            topic = output.topic
            if topic.name != then[i]:
                return differs(then[i], int(record.said_sequence[i]), "", f"again {topic.name} instead")
            if xxhash.xxh3_64_intdigest(payload) == int(record.said_checksum[i]):
                continue
            recorded = find(topic.name, self._outbox.epoch, sequence)
            if recorded is None:
                return differs(topic.name, sequence, "", "other bytes; the recorded message is missing")
            try:
                name, says = first_difference(topic, recorded, payload)
            except MessageError as error:
                name, says = "", str(error)
            return differs(topic.name, sequence, name, says or "other bytes, the same content")
        if len(said) != len(then):
            names = [output.topic.name for output, *_ in said]
            more = (then + names)[len(min(then, names, key=len))] if then or names else ""
            return differs(more, 0, "", f"recorded {len(then)} outputs, again {len(said)}")
        return None
