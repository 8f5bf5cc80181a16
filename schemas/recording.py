"""What a driver tells a recorder, so that a recorded stage can be stepped again with the same result."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Array, Message, column


class StepRecord(Message):
    """One step of a stage, as far as it does not follow from its state: what came, the times, and what it said.

    stamp_ns: the `now` of the step. step: counted from 1 in each life (epoch) of the service. topics: names that the
    columns refer to by index. arrived_*: what the mailbox accepted since the last step, in that order, with the time of
    receipt (mission clock, ns). stopwatch_s: what the stage read from its stopwatch in this step, in that order: an
    anytime planner that a deadline stopped is stopped at the same place again. said_*: the outputs in order; when
    they were packed (ns) and the checksum (xxh3) of their bytes. error: what the step raised, empty when it went well.
    """

    schema_name: ClassVar[str] = "step_record"

    service: str
    step: int = Field(ge=1)
    topics: list[str]
    error: str
    arrived_topic: Annotated[Array, column("uint8", "a")]
    arrived_epoch: Annotated[Array, column("int64", "a", minimum=0)]
    arrived_sequence: Annotated[Array, column("int64", "a", minimum=0)]
    arrived_ns: Annotated[Array, column("int64", "a", minimum=0)]
    stopwatch_s: Annotated[Array, column("float64", "w")]
    said_topic: Annotated[Array, column("uint8", "s")]
    said_sequence: Annotated[Array, column("int64", "s", minimum=1)]
    said_ns: Annotated[Array, column("int64", "s", minimum=0)]
    said_checksum: Annotated[Array, column("uint64", "s")]


class StageSnapshot(Message):
    """A stage, its mailbox and its counters before a step: a replay can begin there.

    step: the next step. options: the stage's configuration as JSON. state: `pack_snapshot` of `stage` (the stage's own
    snapshot), `mailbox` and `sequence` (messages said so far, by topic).
    """

    schema_name: ClassVar[str] = "stage_snapshot"

    service: str
    step: int = Field(ge=1)
    seed: int = Field(ge=0)
    options: str
    state: Annotated[Array, column("uint8", "b")]
