"""The stage contract: a stage is a plain object that steps; the drivers own clocks, transport, threads and files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

from schemas.base import Message

M_co = TypeVar("M_co", bound=Message, covariant=True)

Stamp = int
"""Mission clock, ns since the mission's start."""

SECOND_NS = 1_000_000_000


def root_of(robot: str) -> str:
    """What all Zenoh keys of a robot begin with."""
    return f"plgrim/@v1/{robot}"


@dataclass(frozen=True, slots=True)
class Topic(Generic[M_co]):
    """One row of the table of topics (`schemas/topics.py`).

    name: writer/noun, unique. message: its schema. writer: the one service that may write it. readers: services that
    get it. period_ns: expected time between messages (0: on events). keep_all: every message is delivered in order;
    otherwise only the latest. max_bytes: a larger message is refused. stale_after_ns: age since receipt from which it
    no longer counts (0: never). crosses_link: forwarded between robot and base station. journaled: what a message says
    is acknowledged: its writer has it on the disk before it is published, and still knows it after a restart.
    """

    name: str
    message: type[M_co]
    writer: str
    readers: tuple[str, ...]
    period_ns: int
    keep_all: bool
    max_bytes: int
    stale_after_ns: int
    crosses_link: bool
    says: str
    journaled: bool = False

    def key(self, robot: str, instance: str = "") -> str:
        """The Zenoh key expression: `plgrim/@v1/<robot>/<service>/<noun>`.

        instance: `base` or `standby` for what one of two instances of a service says, before it is settled who is
        obeyed: `plgrim/@v1/<robot>/<instance>/<service>/<noun>`.
        """
        root = root_of(robot)
        return f"{root}/{instance}/{self.name}" if instance else f"{root}/{self.name}"


@dataclass(frozen=True, slots=True)
class Received(Generic[M_co]):
    """A message that arrived. age_ns: local monotonic time since receipt; fresh: not yet seen by an earlier step."""

    message: M_co
    writer: str
    epoch: int
    sequence: int
    sent_ns: int
    age_ns: int
    fresh: bool
    stale: bool


@dataclass(slots=True)
class Inputs:
    """What a stage may read in one step. Every look-up is noted, so that outputs can name what they consumed."""

    messages: Mapping[str, list[Received[Message]]]
    consumed: dict[str, tuple[int, int]] = field(default_factory=dict)

    def latest(self, topic: Topic[M_co]) -> Received[M_co] | None:
        """The newest message of a topic, seen before or not, or None when none has come."""
        found = self.messages.get(topic.name)
        if not found:
            return None
        newest: Received[M_co] = found[-1]  # type: ignore[assignment]
        self.consumed[topic.name] = (newest.epoch, newest.sequence)
        return newest

    def current(self, topic: Topic[M_co]) -> M_co | None:
        """The newest message of a topic unless none has come or it is stale."""
        newest = self.latest(topic)
        return None if newest is None or newest.stale else newest.message

    def new(self, topic: Topic[M_co]) -> list[Received[M_co]]:
        """The messages that no earlier step has seen, oldest first (at most one for a latest-only topic)."""
        fresh: list[Received[M_co]] = [r for r in self.messages.get(topic.name, ()) if r.fresh]  # type: ignore[misc]
        if fresh:
            self.consumed[topic.name] = (fresh[-1].epoch, fresh[-1].sequence)
        return fresh


@dataclass(frozen=True, slots=True)
class Output:
    """One message to publish."""

    topic: Topic[Message]
    message: Message


Outputs = list[Output]


@dataclass(frozen=True, slots=True)
class StageSetup:
    """What a stage is told when it is made. seed: the mission's; every random stream is f(seed, stage, tick).

    stopwatch: seconds of a local monotonic clock, for deadlines of anytime planners; lock-step gives none, and budgets
    are then in simulations alone.
    """

    robot: str
    seed: int
    stopwatch: Callable[[], float] | None = None


@dataclass(frozen=True, slots=True)
class StageSpec:
    """How a driver runs a stage.

    period_ns: time between steps. triggers: topics whose arrival causes a step at once. latency_ns: what lock-step
    waits before a step's outputs are released (the time that the step takes on the robot).
    """

    name: str
    period_ns: int
    triggers: tuple[str, ...] = ()
    latency_ns: int = 0


class Stage(Protocol):
    """A stage: no clock, no transport, no threads, no files and no global random state inside."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """Read the inputs and give what is to be published."""
        ...

    def snapshot(self) -> bytes:
        """Everything that is needed to go on."""
        ...

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot."""
        ...


@runtime_checkable
class Journaling(Protocol):
    """What a stage offers beside `Stage` so that nothing that it has acknowledged is lost between two snapshots."""

    def journal(self, outputs: Outputs) -> bytes:
        """A record of what must survive for these outputs to stay true.

        Together with the last snapshot and the records since then it leads to the state that the outputs tell of. The
        driver writes it before it publishes them; asked only when one of them is of a journaled topic.
        """
        ...

    def replay(self, record: bytes) -> None:
        """Take in a record, after `restore` and in the order in which they were written."""
        ...


@runtime_checkable
class Resuming(Protocol):
    """For a stage that must know when it goes on after the death of its process."""

    def resumed(self) -> None:
        """Called once after `restore` and `replay`, but not when lock-step restores all stages at once.

        Others may have heard what was said since the last record: numbers that must not be given twice are skipped,
        and what does not survive a pause is dropped. Called again for each life that began with the same state and
        ended before it left a snapshot: numbers are skipped once for each.
        """
        ...


def outputs(pairs: Iterable[tuple[Topic[Message], Message]]) -> Outputs:
    """Outputs from (topic, message) pairs."""
    return [Output(topic, message) for topic, message in pairs]
