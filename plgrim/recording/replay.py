"""Steps the stages of a recorded live mission again and compares what they say, byte for byte.

Each stage is stepped by itself, from a recorded snapshot on, with the very messages, times and stopwatch readings that
it had: so a difference is one of the stage (its code, its configuration, the machine), not the echo of another's.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plgrim.errors import PlgrimError
from plgrim.recording.envelope import Raw
from plgrim.recording.life import Difference, Life
from plgrim.recording.reader import Warn, read_raw
from plgrim.registry import STAGES
from plgrim.runtime.zenoh_session import is_latched
from schemas.codec import decode
from schemas.contract import SECOND_NS, Topic
from schemas.recording import StageSnapshot, StepRecord
from schemas.topics import recorder_topics, snapshot_topic, steps_topic, topic_named

_AHEAD_NS = 4 * SECOND_NS
"""A step is done when the recording was read so much further: topics are recorded by threads of their own."""
_KEPT_NS = 40 * SECOND_NS
_KEPT_QUEUED, _KEPT_LATEST = 64, 2

Key = tuple[str, int, int]


@dataclass(slots=True)
class ReplayReport:
    """What a replay found. steps, outputs: done again and compared, by stage. gaps: what could not be, and why.
    before: steps from before the first snapshot, when the recorder had only just come.

    differences: the first of each stage's life. began_ns, ended_ns: mission clock of the first and last step.
    """

    steps: Counter[str] = field(default_factory=Counter)
    outputs: Counter[str] = field(default_factory=Counter)
    gaps: Counter[str] = field(default_factory=Counter)
    before: Counter[str] = field(default_factory=Counter)
    differences: list[Difference] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    began_ns: int = 0
    ended_ns: int = 0
    wall_s: float = 0.0

    @property
    def same(self) -> bool:
        """Whether everything was stepped again, and said the same."""
        return bool(self.steps) and not self.differences and not self.gaps

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "same": self.same,
            "steps": dict(self.steps),
            "outputs": dict(self.outputs),
            "gaps": dict(self.gaps),
            "before": dict(self.before),
            "differences": [d.summary() for d in self.differences],
            "warnings": self.warnings,
            "mission_s": (self.ended_ns - self.began_ns) / SECOND_NS,
            "wall_s": round(self.wall_s, 2),
        }


class _Shelf:
    """The messages of the last while, by topic, epoch and sequence."""

    def __init__(self) -> None:
        self._payloads: dict[Key, bytes] = {}
        self._order: dict[str, deque[tuple[int, Key]]] = {}

    def put(self, raw: Raw) -> None:
        """Keep a message; old ones go."""
        key = (raw.topic, raw.epoch, raw.sequence)
        self._payloads[key] = raw.payload
        order = self._order.setdefault(raw.topic, deque())
        order.append((raw.sent_ns, key))
        kept = _KEPT_QUEUED if _is_kept(topic_named(raw.topic)) else _KEPT_LATEST
        while len(order) > kept and order[0][0] < raw.sent_ns - _KEPT_NS:
            self._payloads.pop(order.popleft()[1], None)

    def get(self, topic: str, epoch: int, sequence: int) -> bytes | None:
        """A message, or None when it was not recorded."""
        return self._payloads.get((topic, epoch, sequence))


def _is_kept(topic: Topic[Any]) -> bool:
    return topic.keep_all or is_latched(topic)


@dataclass(slots=True)
class Replay:
    """Replays recordings. overrides: configuration by stage that replaces what was recorded.

    speed: mission seconds a wall second; 0 as fast as the machine can. each_step: called with the mission clock.
    """

    stages: Collection[str] = STAGES
    overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    speed: float = 0.0
    each_step: Callable[[int], None] | None = None
    _report: ReplayReport = field(default_factory=ReplayReport)
    _shelf: _Shelf = field(default_factory=_Shelf)
    _lives: dict[tuple[str, int], Life] = field(default_factory=dict)
    _snapshots: dict[tuple[str, int], dict[int, tuple[StageSnapshot, str]]] = field(default_factory=dict)
    _begun: set[tuple[str, int]] = field(default_factory=set)
    _steps: deque[tuple[int, int, StepRecord]] = field(default_factory=deque)
    _began_s: float = 0.0

    def run(self, path: Path, stop: Callable[[], bool] = lambda: False) -> ReplayReport:
        """Replay a file or a folder of segments. Raises RecordingError, and ConfigError for a world that is gone."""
        report = self._report
        began = time.monotonic()
        newest = 0
        for raw in self._messages(path, report.warnings.append):
            if stop():
                break
            newest = max(newest, raw.sent_ns)
            self._take(raw)
            while self._steps and self._steps[0][0] <= newest - _AHEAD_NS:
                self._step(*self._steps.popleft()[1:])
        while self._steps and not stop():
            self._step(*self._steps.popleft()[1:])
        report.wall_s = time.monotonic() - began
        if not report.steps and not report.gaps and not report.before:
            report.gaps["no steps are recorded of " + ", ".join(sorted(self.stages))] += 1
        return report

    def _messages(self, path: Path, warn: Warn) -> Iterator[Raw]:
        unwanted = {t.name for s in STAGES if s not in self.stages for t in recorder_topics(s)}
        return read_raw(path, warn, lambda topic: topic not in unwanted and not topic.endswith("/health"))

    def _take(self, raw: Raw) -> None:
        service, _, noun = raw.topic.partition("/")
        if noun == "steps":
            topic = steps_topic(service)
            record, _ = decode(raw.payload, topic.message, topic.max_bytes)
            self._steps.append((raw.sent_ns, raw.epoch, record))
        elif noun == "snapshot":
            held = snapshot_topic(service)
            snapshot, envelope = decode(raw.payload, held.message, held.max_bytes)
            waiting = self._snapshots.setdefault((service, raw.epoch), {})
            waiting[snapshot.step] = snapshot, envelope.robot
        else:
            self._shelf.put(raw)

    def _step(self, epoch: int, record: StepRecord) -> None:
        key = (record.service, epoch)
        life = self._life(key, record)
        if life is None:
            return
        report = self._report
        report.began_ns = report.began_ns or record.stamp_ns
        report.ended_ns = max(report.ended_ns, record.stamp_ns)
        self._pace(record.stamp_ns)
        missing = life.take_arrivals(record, self._shelf.get)
        if missing:
            report.gaps[f"{record.service}: {missing} was not recorded"] += 1
            self._lives.pop(key)
            return
        difference = life.step(record, self._shelf.get)
        report.steps[record.service] += 1
        report.outputs[record.service] += len(record.said_topic)
        if difference is not None:
            report.differences.append(difference)
            life.over = True
        if self.each_step is not None:
            self.each_step(record.stamp_ns)

    def _life(self, key: tuple[str, int], record: StepRecord) -> Life | None:
        """The stage that this step is the next one of; None when it cannot be stepped."""
        life = self._lives.get(key)
        self._snapshots.get(key, {}).pop(
            record.step if life is not None and life.next_step == record.step else -1, None
        )
        if life is not None and life.over:
            return None
        if life is not None and record.step != life.next_step:
            if record.step < life.next_step:
                return None
            self._report.gaps[f"{key[0]}: steps were not recorded"] += record.step - life.next_step
            self._lives.pop(key)
            life = None
        if life is None:
            life = self._begin(key, record)
        return life

    def _begin(self, key: tuple[str, int], record: StepRecord) -> Life | None:
        held = self._snapshots.get(key, {})
        for step in [step for step in held if step < record.step]:
            del held[step]
        if record.step not in held:
            into = self._report.gaps if key in self._begun else self._report.before
            into[f"{key[0]}: steps before a snapshot"] += 1
            return None
        snapshot, robot = held.pop(record.step)
        self._begun.add(key)
        try:
            life = Life(key, robot, snapshot, self.overrides.get(key[0], {}))
        except PlgrimError as error:
            self._report.gaps[f"{key[0]}: cannot be made: {error}"] += 1
            return None
        self._lives[key] = life
        return life

    def _pace(self, now: int) -> None:
        if not self.speed:
            return
        if not self._began_s:
            self._began_s = time.monotonic() - now / SECOND_NS / self.speed
        time.sleep(max(0.0, self._began_s + now / SECOND_NS / self.speed - time.monotonic()))
