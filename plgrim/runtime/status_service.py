"""The status service live: its core fed over Zenoh, its HTTP server, its requests for the whole graph."""

from __future__ import annotations

import threading
from typing import cast

from plgrim.config import Config, check_service
from plgrim.errors import ConfigError, PortTakenError
from plgrim.logs import Seldom, get_logger
from plgrim.runtime.clock import MissionClock
from plgrim.runtime.keeper import Keeper
from plgrim.runtime.mailbox import Mailbox, Outbox
from plgrim.runtime.router import page_address
from plgrim.runtime.service import LiveService
from plgrim.security.access import COMMAND_QUERY
from schemas.base import Message
from schemas.contract import Output, Topic, root_of
from schemas.topics import COMMAND, LINK, STATUS_GRAPH_REQUEST, read_by, topic_named
from services.status import app
from services.status.commands import answer_json
from services.status.config import Config as StatusConfig
from services.status.security import SecurityError

_TICK_S = 0.2


def command_key(robot: str) -> str:
    """Where commands are asked for over Zenoh: a query with the command as JSON, answered with the mission's answer."""
    return f"{root_of(robot)}/{COMMAND_QUERY}"


class StatusFeed:
    """Takes payloads of any topic of the status, refuses as every mailbox does, and shows the rest to the core."""

    def __init__(
        self, robot: str, shared: app.SharedStatus, clock: MissionClock, with_link: bool = True
    ) -> None:
        """with_link: there is a link to another host, which is to report."""
        self._with_link = with_link
        self._mailbox = Mailbox(robot, tuple(read_by("status")))
        self._shared = shared
        self._clock = clock
        self._lock = threading.Lock()
        self._refusals = Seldom()

    def accept(self, topic: Topic[Message], payload: bytes) -> None:
        """One payload; called from the thread of its subscription."""
        now = self._clock.now_ns()
        with self._lock:
            if not self._mailbox.accept(topic, payload, now):
                if more := self._refusals.more(topic.name):
                    get_logger().warning("message refused", reason=self._mailbox.last_refusal, times=more)
                return
            received = self._mailbox.inputs(now).new(topic)
            self._mailbox.stepped()
        for one in received:
            self._shared.observe(topic.name, one.message)

    def report(self, now: int) -> tuple[dict[str, int], list[str]]:
        """For health: what was refused, and what is missing."""
        with self._lock:
            missing = self._mailbox.missing(now)
            dropped = dict(self._mailbox.dropped)
        if not self._with_link:
            missing = [name for name in missing if topic_named(name).writer != LINK]
        return dropped, missing


def run_status(config: Config, stop: threading.Event) -> None:
    """Serve the status until `stop`. Raises PortTakenError, NoRouterError, AlreadyRunningError, ConfigError."""
    options = cast(StatusConfig, check_service(config, "status"))
    clock = MissionClock.of(config.clock, config.runtime.state_dir)
    shared = app.SharedStatus(options, config.robot, clock.now_ns)
    shared.configuration = config.model_dump(mode="json")
    try:
        server = app.StatusServer(shared)
    except app.PortTakenError as error:
        raise PortTakenError(f"{error} in the configuration, or PLGRIM_STATUS__PORT") from error
    except (SecurityError, OSError) as error:
        raise ConfigError(f"status: {error}") from error
    try:
        with LiveService("status", config, stop) as service:
            keeper = Keeper.of(config.runtime, config.robot, "status")
            if keeper is not None:
                keeper.recover(lambda: shared, service.clock.now_ns())
            _serve(
                service, server, StatusFeed(config.robot, shared, clock, bool(config.link.host)), stop, keeper
            )
    finally:
        server.stop(1.0)


def _serve(
    service: LiveService,
    server: app.StatusServer,
    feed: StatusFeed,
    stop: threading.Event,
    keeper: Keeper | None,
) -> None:
    outbox = Outbox(service.config.robot, "status", service.epoch)
    sending = threading.Lock()

    def say(topic: Topic[Message], message: Message) -> None:
        """Publish, from any thread."""
        with sending:
            payload = outbox.pack(Output(topic, message), service.clock.now_ns(), {})
            service.link.publish(topic, payload)

    server.shared.desk.send = lambda command: say(COMMAND, command)
    service.link.declare(COMMAND)
    shared = server.shared
    service.link.serve(
        command_key(service.config.robot), lambda payload: answer_json(shared.desk, payload, shared.fences)
    )
    for topic in read_by("status"):
        service.link.subscribe(topic, feed.accept)
    service.mailbox_report = feed.report
    server.start()
    service.monitor.expect(_TICK_S)
    service.monitor.ready = True
    options = server.shared.config
    page = page_address(options.host, server.port, secure=bool(options.tls_certificate_file))
    get_logger().info("ready", page=page)
    while not stop.wait(_TICK_S):
        service.monitor.step_began()
        now = service.clock.now_ns()
        request = server.shared.graph_request(now)
        if request is not None:
            say(STATUS_GRAPH_REQUEST, request)
        if keeper is not None:
            keeper.after_step(server.shared, now)
            service.monitor.degraded = keeper.trouble
        service.monitor.step_ended()
    if keeper is not None:
        keeper.close(server.shared, service.clock.now_ns())
