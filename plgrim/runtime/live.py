"""The live driver: one stage in a process of its own, over Zenoh, on the machine's clock.

Threads: one a subscription decodes into the mailbox under a lock; the heartbeat publishes health; the main thread
steps the stage, so that steps never overlap and signals are served between them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import zenoh

from plgrim.config import Config, check_service
from plgrim.errors import ServiceFailedError
from plgrim.logs import get_logger
from plgrim.registry import stage_module, world_errors
from plgrim.runtime.keeper import Keeper
from plgrim.runtime.mailbox import Mailbox, Outbox
from plgrim.runtime.process import Interrupted, interruptible
from plgrim.runtime.service import LiveService
from schemas.base import Message
from schemas.contract import Inputs, Stage, StageSetup, StageSpec, Stamp, Topic
from schemas.topics import read_by, written_by

MakeStage = Callable[[], tuple[StageSpec, Stage]]


def run_stage(name: str, config: Config, stop: threading.Event) -> None:
    """Run a stage of the registry until `stop` is set. Raises PlgrimError."""
    options = check_service(config, name)
    if options is None:
        raise ServiceFailedError(f"there is no module services.{name}.stage")
    module = stage_module(name)

    def make() -> tuple[StageSpec, Stage]:
        if hasattr(module, "warm_up"):
            module.warm_up()
        with world_errors(name):
            stage: Stage = module.create(
                options, StageSetup(config.robot, config.seed, stopwatch=time.monotonic)
            )
        return module.spec(options), stage

    drive(name, config, make, stop)


def drive(name: str, config: Config, make: MakeStage, stop: threading.Event) -> None:
    """Run any stage under the name of a service until `stop` is set.

    Connects first, so that a second instance is refused before it compiles or loads anything. Raises PlgrimError, and
    what `make` raises.
    """
    with LiveService(name, config, stop) as service:
        keeper = Keeper.of(config.runtime, config.robot, name)
        try:
            with interruptible(stop):
                spec, stage = _make(make, keeper, service.clock.now_ns())
        except Interrupted:
            return
        LiveDriver(service, spec, stage, keeper).run(stop)


def _make(make: MakeStage, keeper: Keeper | None, now: Stamp) -> tuple[StageSpec, Stage]:
    """The stage: as it was when its process died if a keeper knows, else new."""
    if keeper is None:
        return make()
    specs: list[StageSpec] = []

    def stage() -> Stage:
        spec, made = make()
        specs.append(spec)
        return made

    recovered = keeper.recover(stage, now)
    return specs[-1], recovered


class LiveDriver:
    """Steps a stage at its period and when a trigger arrives; publishes what it gives."""

    def __init__(
        self, service: LiveService, spec: StageSpec, stage: Stage, keeper: Keeper | None = None
    ) -> None:
        config = service.config
        self._service = service
        self._clock = service.clock
        self._spec = spec
        self._stage = stage
        self._keeper = keeper
        self._mailbox = Mailbox(config.robot, tuple(read_by(service.name)))
        self._outbox = Outbox(config.robot, service.name, service.epoch)
        self._wake = threading.Condition()
        self._triggered = False
        self._triggers = frozenset(spec.triggers)
        self._errors_in_a_row = 0
        self._log = get_logger()

    def run(self, stop: threading.Event) -> None:
        """Subscribe, become ready, step until `stop`. Raises ServiceFailedError after too many errors in a row."""
        for topic in written_by(self._service.name):
            self._service.link.declare(topic)
        for topic in self._mailbox.topics:
            self._service.link.subscribe(topic, self._accept)
        self._service.mailbox_report = self._mailbox_report
        self._service.knows = self._knows
        self._service.monitor.ready = True
        self._log.info("ready", period_ms=self._spec.period_ns / 1e6, topics=len(self._mailbox.topics))
        try:
            self._run(stop)
        finally:
            if self._keeper is not None:
                self._keeper.close()
        self._log.info("stopped", steps=self._service.monitor.steps)

    def _run(self, stop: threading.Event) -> None:
        due = self._clock.now_ns()
        while not stop.is_set():
            triggered = self._wait(due, stop)
            if stop.is_set():
                break
            began = self._clock.now_ns()
            self._step(began)
            due = next_due(self._spec.period_ns, due, began, self._clock.now_ns(), triggered)
        if self._keeper is not None and not self._errors_in_a_row:
            self._keeper.close(self._stage, self._clock.now_ns())

    def _accept(self, topic: Topic[Message], payload: bytes) -> None:
        with self._wake:
            accepted = self._mailbox.accept(topic, payload, self._clock.now_ns())
            refusal = "" if accepted else self._mailbox.last_refusal
            if accepted and topic.name in self._triggers:
                self._triggered = True
                self._wake.notify()
        if refusal:
            self._log.warning("message refused", reason=refusal)

    def _wait(self, due: Stamp, stop: threading.Event) -> bool:
        """Wait until `due` or a trigger; True for a trigger. Short waits, since a signal only sets `stop`."""
        with self._wake:
            while not self._triggered and not stop.is_set():
                left_s = self._clock.wall_seconds(due - self._clock.now_ns())
                if left_s <= 0:
                    return False
                self._wake.wait(min(left_s, 0.2))
            triggered, self._triggered = self._triggered, False
            return triggered

    def _step(self, now: Stamp) -> None:
        with self._wake:
            inputs = self._mailbox.inputs(now)
            # Before the step, not after it: what arrives meanwhile stays fresh, and queued, for the next one.
            self._mailbox.stepped()
        monitor = self._service.monitor
        monitor.step_began()
        try:
            self._publish(inputs, now)
            if self._keeper is not None:
                self._keeper.after_step(self._stage, now)
            self._errors_in_a_row = 0
        except Exception as error:
            self._failed(error)
        finally:
            monitor.step_ended()

    def _publish(self, inputs: Inputs, now: Stamp) -> None:
        """Step, write down what is acknowledged, and only then say it."""
        found = self._stage.step(now, inputs)
        payloads = [self._outbox.pack(output, self._clock.now_ns(), inputs.consumed) for output in found]
        if self._keeper is not None:
            self._keeper.before_publishing(self._stage, found)
        for output, payload in zip(found, payloads, strict=True):
            try:
                self._service.link.publish(output.topic, payload)
            except zenoh.ZError as error:
                self._service.monitor.dropped[f"{output.topic.name}:not_sent"] += 1
                self._log.warning("not sent", topic=output.topic.name, error=str(error)[:200])

    def _failed(self, error: Exception) -> None:
        self._errors_in_a_row += 1
        self._service.monitor.failed(error)
        self._log.error("step failed", in_a_row=self._errors_in_a_row, exc_info=error)
        if self._errors_in_a_row >= self._service.config.runtime.max_consecutive_errors:
            raise ServiceFailedError(
                f"{self._service.name}: {self._errors_in_a_row} steps in a row failed, last: {error!r}"
            ) from error

    def _knows(self) -> dict[str, tuple[int, int]]:
        with self._wake:
            return self._mailbox.newest()

    def _mailbox_report(self, now: Stamp) -> tuple[dict[str, int], list[str]]:
        with self._wake:
            return dict(self._mailbox.dropped), self._mailbox.missing(now)


def next_due(period_ns: int, due: Stamp, began: Stamp, ended: Stamp, triggered: bool) -> Stamp:
    """When to step next. A trigger restarts the period; ticks that were overrun are skipped, never piled up."""
    period_ns = max(1, period_ns)
    following = (began if triggered else due) + period_ns
    if following > ended:
        return following
    return following + ((ended - following) // period_ns + 1) * period_ns
