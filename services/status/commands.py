"""The operator's commands on their way to the mission and back: sent, answered, never carried out twice."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.fences import MAX_FENCES, Fence
from schemas.operation import CommandAnswer, CommandKind, MissionCommand
from services.status.geojson import FeatureCollectionOut, FenceRequest
from services.status.problems import FieldError, ProblemError, field_name, problem_json

Send = Callable[[MissionCommand], None]


class CommandReport(BaseModel):
    """What became of a command, in the mission's own words.

    A repeated command (the same id) is not carried out again and gets the same answer.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "command_id": "7f0c2a",
                    "kind": "pause",
                    "accepted": True,
                    "reason": "paused by the operator; paused after explore",
                    "phase": "paused",
                    "fence_ids": [],
                    "fences_version": 0,
                    "mission_time_s": 312.5,
                }
            ]
        }
    )

    command_id: str
    kind: CommandKind
    accepted: bool
    reason: str
    phase: str = Field(description="Of the mission, after the command.")
    fence_ids: list[str] = Field(description="Polygons that were added, replaced or taken away.")
    fences_version: int
    mission_time_s: float = Field(description="When it was answered, mission clock.")

    @classmethod
    def of(cls, answer: CommandAnswer) -> CommandReport:
        """From the message."""
        return cls(
            command_id=answer.command_id,
            kind=answer.kind,
            accepted=answer.accepted,
            reason=answer.reason,
            phase=answer.phase.value,
            fence_ids=answer.fence_ids,
            fences_version=answer.fences_version,
            mission_time_s=answer.stamp_ns / 1e9,
        )


class CommandDesk:
    """Hands commands to the mission and waits for its answers. Used by many threads.

    send: puts a command on the wire; set by whoever runs the service. stamp_ns: the mission clock.
    """

    def __init__(self, timeout_s: float, stamp_ns: Callable[[], int]) -> None:
        self.send: Send | None = None
        self._timeout_s = timeout_s
        self._stamp_ns = stamp_ns
        self._lock = threading.Lock()
        self._waiting: dict[str, list[_Slip]] = {}

    def answered(self, answer: CommandAnswer) -> None:
        """The mission has said something; called by the subscriber's thread."""
        with self._lock:
            slips = self._waiting.pop(answer.command_id, [])
        for slip in slips:
            slip.answer = answer
            slip.done.set()

    def ask(
        self,
        kind: CommandKind,
        command_id: str | None = None,
        time_budget_s: float = 0.0,
        fences: list[Fence] | None = None,
        fence_ids: list[str] | None = None,
    ) -> CommandAnswer:
        """Send a command and wait for its answer. Raises ProblemError: 503 without a mission, 504 without an answer."""
        command = MissionCommand(
            stamp_ns=max(0, self._stamp_ns()),
            command_id=command_id or uuid.uuid4().hex,
            kind=kind,
            time_budget_s=time_budget_s,
            fences=fences or [],
            fence_ids=fence_ids or [],
        )
        if self.send is None:
            raise ProblemError(503, "this status service has no way to the mission: it only watches")
        slip = _Slip()
        with self._lock:
            self._waiting.setdefault(command.command_id, []).append(slip)
        try:
            self.send(command)
            slip.done.wait(self._timeout_s)
        finally:
            with self._lock:
                slips = self._waiting.get(command.command_id, [])
                if slip in slips:
                    slips.remove(slip)
                if not slips:
                    self._waiting.pop(command.command_id, None)
        if slip.answer is None:
            raise ProblemError(
                504,
                f"the mission did not answer within {self._timeout_s:g} s: it is down or out of reach. Whether command "
                f"{command.command_id} was carried out is not known; send it again with the same Idempotency-Key",
            )
        return slip.answer


class _Slip:
    """One who waits for an answer."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.answer: CommandAnswer | None = None


class CommandBody(BaseModel):
    """A command as JSON: what the Zenoh queryable takes. The members that a kind does not use are left out."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    kind: CommandKind
    command_id: str | None = Field(None, min_length=1, max_length=64)
    time_budget_s: float | None = Field(
        None, ge=0, le=1e9, description="budget: from start to end, s; 0: none."
    )
    fence: FenceRequest | None = Field(None, description="fence: the polygons.")
    fence_ids: list[str] = Field(
        default_factory=list, max_length=MAX_FENCES, description="unfence: which; none given: all."
    )

    def ask(self, desk: CommandDesk) -> CommandAnswer:
        """Send it. Raises ProblemError, also when a member is missing."""
        if self.kind == CommandKind.FENCE and self.fence is None:
            raise ProblemError(422, "fence: is missing", [FieldError(field="fence", message="is missing")])
        if self.kind == CommandKind.BUDGET and self.time_budget_s is None:
            wrong = FieldError(field="time_budget_s", message="is missing")
            raise ProblemError(422, "time_budget_s: is missing", [wrong])
        fences = self.fence.fences() if self.fence is not None else []
        return desk.ask(self.kind, self.command_id, self.time_budget_s or 0.0, fences, self.fence_ids)


def answer_json(desk: CommandDesk, payload: bytes, fences: Callable[[], FeatureCollectionOut]) -> bytes:
    """A command as JSON bytes in, the mission's answer, or a problem, as JSON bytes out: the Zenoh queryable.

    Nothing in: the fences that hold, as GeoJSON.
    """
    try:
        if not payload:
            return fences().model_dump_json().encode()
        report = CommandReport.of(CommandBody.model_validate_json(payload).ask(desk))
        return report.model_dump_json().encode()
    except ValidationError as error:
        errors = [FieldError(field=field_name(e["loc"]), message=e["msg"]) for e in error.errors()]
        return problem_json(ProblemError(422, f"{errors[0].field}: {errors[0].message}", errors))
    except ProblemError as error:
        return problem_json(error)
