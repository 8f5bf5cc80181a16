"""The lock-step driver: all stages in one process, a virtual clock, messages through the real codec.

Deterministic: the same seed gives the same bytes. A step's outputs are released at `now + latency` of its stage, as
they would be on the robot; without latency, reconciliation would have nothing to do.
"""

from __future__ import annotations

import heapq
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import xxhash

from plgrim.registry import STAGES, make_stage
from plgrim.runtime.mailbox import Mailbox, Outbox, SharedDecoder
from schemas.base import Message
from schemas.contract import Stage, StageSetup, StageSpec, Stamp, Topic
from schemas.snapshot import pack_snapshot, unpack_snapshot
from schemas.topics import TOPICS, read_by, topic_named

Observer = Callable[[Topic[Message], Message, Stamp], None]


@dataclass(slots=True)
class _Runner:
    spec: StageSpec
    stage: Stage
    mailbox: Mailbox
    outbox: Outbox
    due_ns: int
    triggers: frozenset[str]
    step_s: list[float] = field(default_factory=list)


class Lockstep:
    """Runs stages under a virtual clock.

    options: configuration by service. observer: called with every message when a stage has made it. extra: stages that
    are given instead of made, by the service whose place they take (they write its topics).
    digest(): hash of every byte that was published, to compare runs.
    """

    def __init__(
        self,
        options: Mapping[str, Mapping[str, Any]],
        seed: int,
        robot: str = "robot",
        observer: Observer | None = None,
        stages: tuple[str, ...] = STAGES,
        extra: Mapping[str, tuple[StageSpec, Stage]] | None = None,
    ) -> None:
        self.now: Stamp = 0
        self._observer = observer
        self._digest = b""
        self._decode = SharedDecoder()
        self._order = 0
        self._pending: list[tuple[Stamp, int, Topic[Message], bytes]] = []
        self._runners: dict[str, _Runner] = {}
        given = dict(extra or {})
        for name in (*stages, *(n for n in given if n not in stages)):
            setup = StageSetup(robot, seed)
            spec, stage = given[name] if name in given else make_stage(name, options.get(name, {}), setup)
            mailbox = Mailbox(robot, tuple(read_by(name)))
            outbox = Outbox(robot, name, 1)
            self._runners[name] = _Runner(spec, stage, mailbox, outbox, 0, frozenset(spec.triggers))
        self._readers: dict[str, list[_Runner]] = defaultdict(list)
        for topic in TOPICS:
            for reader in topic.readers:
                if reader in self._runners:
                    self._readers[topic.name].append(self._runners[reader])

    def run_until(self, end: Stamp) -> None:
        """Advance the clock to `end`, stepping every stage that is due on the way."""
        while True:
            due = min(runner.due_ns for runner in self._runners.values())
            if self._pending:
                due = min(due, self._pending[0][0])
            if due > end:
                self.now = end
                return
            self.now = due
            self._release()
            for runner in self._runners.values():
                if runner.due_ns <= self.now:
                    self._step(runner)

    def wake(self, name: str, at: Stamp) -> None:
        """Let a stage step at a time (not before now), whatever its period: for input that comes from a caller."""
        self._runners[name].due_ns = max(at, self.now)

    def _release(self) -> None:
        while self._pending and self._pending[0][0] <= self.now:
            _, _, topic, payload = heapq.heappop(self._pending)
            hasher = xxhash.xxh3_128(self._digest + topic.name.encode())
            hasher.update(payload)
            self._digest = hasher.digest()
            for runner in self._readers[topic.name]:
                if (
                    runner.mailbox.accept(topic, payload, self.now, self._decode)
                    and topic.name in runner.triggers
                ):
                    runner.due_ns = self.now

    def _step(self, runner: _Runner) -> None:
        began = time.perf_counter()
        inputs = runner.mailbox.inputs(self.now)
        for output in runner.stage.step(self.now, inputs):
            payload = runner.outbox.pack(output, self.now, inputs.consumed)
            self._order += 1
            heapq.heappush(
                self._pending, (self.now + runner.spec.latency_ns, self._order, output.topic, payload)
            )
            if self._observer is not None:
                self._observer(output.topic, output.message, self.now)
        runner.mailbox.stepped()
        runner.due_ns = self.now + runner.spec.period_ns
        runner.step_s.append(time.perf_counter() - began)

    def stage(self, name: str) -> Stage:
        """The stage object of a service, for tests and library use."""
        return self._runners[name].stage

    def step_seconds(self) -> dict[str, list[float]]:
        """Wall seconds of every step so far by service; measurement only, no stage sees them."""
        return {name: runner.step_s for name, runner in self._runners.items()}

    def dropped(self) -> dict[str, int]:
        """Refused messages by `service/topic:reason`."""
        return {f"{n}/{k}": c for n, r in self._runners.items() for k, c in sorted(r.mailbox.dropped.items())}

    def digest(self) -> str:
        """Hash of every published byte in order."""
        return self._digest.hex()

    def snapshot(self) -> bytes:
        """The whole run between two calls of `run_until`: stages, what they have received, what is under way."""
        runners = {
            name: {
                "stage": runner.stage.snapshot(),
                "mailbox": runner.mailbox.state(),
                "sequence": dict(runner.outbox.sequence),
                "due_ns": runner.due_ns,
            }
            for name, runner in self._runners.items()
        }
        pending = [[due, order, topic.name, payload] for due, order, topic, payload in self._pending]
        return pack_snapshot(
            {
                "now": self.now,
                "order": self._order,
                "digest": self._digest,
                "pending": pending,
                "runners": runners,
            }
        )

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot of a run with the same options, seed and stages: every byte is as if never stopped.

        Raises MalformedError when it is damaged, KeyError when it is of other stages.
        """
        state = unpack_snapshot(snapshot)
        for name, runner in self._runners.items():
            held = state["runners"][name]
            runner.stage.restore(held["stage"])
            runner.mailbox.set_state(held["mailbox"])
            runner.outbox.sequence = Counter(held["sequence"])
            runner.due_ns = held["due_ns"]
        self._pending = [
            (due, order, topic_named(name), payload) for due, order, name, payload in state["pending"]
        ]
        self.now, self._order, self._digest = state["now"], state["order"], state["digest"]
