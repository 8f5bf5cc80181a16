"""Zenoh sessions, subscriptions and publications as the services use them.

Services are clients of one router; scouting and gossip are off. Nothing is done in Zenoh's callbacks: every
subscription is a channel that a thread of its own empties. A thread receives from the *handler*: receiving from the
subscriber would hold it borrowed, and it could then not be closed. `Session.close` ends the channels, and with them the
threads; `Link.close` waits for them, since a thread that sits in Zenoh while the interpreter ends aborts the process.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import zenoh
from zenoh import ext

from plgrim.config import RouterConfig
from plgrim.errors import NoRouterError
from plgrim.hosts import SECURE, protocol
from plgrim.logs import get_logger
from plgrim.security.access import TOOLS
from plgrim.security.certificates import CERTIFICATE, KEY, TRUSTED
from plgrim.security.exposure import certificate_folder
from schemas.base import Message
from schemas.compact import compact
from schemas.contract import SECOND_NS, Topic

_FIFO = 1024
_KEEP_ALL_CACHE = 64
_LARGE_CACHE = 8
_LARGE_BYTES = 1024 * 1024
_OPEN_TIMEOUT_MS = 2000
_SERVED_AT_ONCE = 8
_RECEIVERS = 16
Receive = Callable[[Topic[Message], bytes], None]


def many_receivers() -> None:
    """Give this process more of Zenoh's receiving threads; before its first session, for one with several connections.

    Zenoh has two of them for all connections of a process, and closes a connection on one of them. Where its peer is
    gone and data is unsent, that takes ten seconds (SO_LINGER): two dead connections, and nothing is received.
    """
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {_RECEIVERS}))")


def session_config(router: RouterConfig, mode: str, process: str = TOOLS) -> dict[str, Any]:
    """Zenoh's configuration. mode: `client` (connects) or `router` (listens). process: whose certificate to show.

    Raises CertificateError.
    """
    endpoints = [router.endpoint, *router.listen] if mode == "router" else [router.client_endpoint]
    place: dict[str, Any] = (
        {"listen": {"endpoints": endpoints, "exit_on_failure": True}}
        if mode == "router"
        else {
            "connect": {
                "endpoints": endpoints,
                "timeout_ms": _OPEN_TIMEOUT_MS,
                "retry": {"period_init_ms": 250, "period_max_ms": 1000, "period_increase_factor": 2},
            }
        }
    )
    return place | {
        "mode": mode,
        # No wall-clock time on the wire: nobody reads it, and one that is off by half a second is an error a message.
        "timestamping": {"enabled": False},
        "queries_default_timeout": 1000,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        # Without permissions too: a stock zenohd switches it on, whatever its file says.
        "adminspace": {"enabled": False, "permissions": {"read": False, "write": False}},
        "transport": {
            "shared_memory": {"enabled": router.shared_memory},
            "unicast": {"open_timeout": 1500, "accept_timeout": 1500},
            "link": {
                **_tls(router, mode, process, endpoints),
                "tx": {
                    "lease": router.lease_ms,
                    "keep_alive": 4,
                    # Zenoh discards large messages after 1 ms of congestion; with these none was lost on loopback.
                    "queue": {
                        "congestion_control": {
                            "drop": {"wait_before_drop": 50_000, "max_wait_before_drop_fragments": 1_000_000},
                            "block": {"wait_before_close": 1_000_000},
                        }
                    },
                },
            },
        },
    }


def _tls(router: RouterConfig, mode: str, process: str, endpoints: list[str]) -> dict[str, Any]:
    """Mutual TLS, where an endpoint has it. Both sides trust the issuers in `trusted.pem`, and nobody else."""
    if not any(protocol(endpoint) in SECURE for endpoint in endpoints):
        return {}
    folder = certificate_folder(router, process)
    side = "listen" if mode == "router" else "connect"
    return {
        "tls": {
            "enable_mtls": True,
            "root_ca_certificate": str(folder / TRUSTED),
            f"{side}_certificate": str(folder / CERTIFICATE),
            f"{side}_private_key": str(folder / KEY),
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
    }


def open_session(
    router: RouterConfig, mode: str, stop: threading.Event, timeout_s: float, process: str = TOOLS
) -> zenoh.Session:
    """Open a session; a client waits for its router in short tries, so that signals are served in between.

    Raises NoRouterError after `timeout_s`, or when `stop` is set; zenoh.ZError when a router cannot listen.
    """
    return open_config(session_config(router, mode, process), router, stop, timeout_s)


def open_config(
    settings: dict[str, Any], router: RouterConfig, stop: threading.Event, timeout_s: float
) -> zenoh.Session:
    """Open a session from Zenoh's own configuration. Raises as `open_session` does."""
    zenoh.init_log_from_env_or("error")
    mode, config = settings["mode"], json.dumps(settings)
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return zenoh.open(zenoh.Config.from_json5(config))
        except zenoh.ZError as error:
            if mode == "router":
                raise
            if stop.is_set() or time.monotonic() > deadline:
                raise NoRouterError(
                    f"no Zenoh router answers at {router.client_endpoint}: start one with `plgrim router`, "
                    f"or name another with router.endpoint or PLGRIM_ROUTER ({_first_line(error)}){_hint(router)}"
                ) from error
            stop.wait(0.3)


def _hint(router: RouterConfig) -> str:
    """Zenoh says no more than `Timeout!` when a certificate is refused."""
    if protocol(router.client_endpoint) not in SECURE:
        return ""
    return "; or one of the certificates was refused: expired, revoked, of another authority, or for another host name"


def _first_line(error: BaseException) -> str:
    return str(error).split(" at /")[0][:200]


def is_latched(topic: Topic[Message]) -> bool:
    """Whether late joiners get the last message: what comes rarely and does not go stale.

    Not what goes stale (an old plan must not look fresh to a follower that restarts), and not requests and commands
    (an old stop must not stop a new mission).
    """
    return topic.period_ns >= SECOND_NS // 2 and topic.stale_after_ns == 0


def _cached(topic: Topic[Message]) -> int:
    """Samples that a publisher keeps for late joiners and for readers that missed some."""
    if not topic.keep_all:
        return 1
    return _LARGE_CACHE if topic.max_bytes > _LARGE_BYTES else _KEEP_ALL_CACHE


def _is_advanced(topic: Topic[Message]) -> bool:
    return topic.keep_all or is_latched(topic)


@dataclass(slots=True)
class Link:
    """One session with what it publishes, subscribes and answers. Use as a context manager."""

    session: zenoh.Session
    robot: str
    instance: str = ""
    """Which of two instances of a service publishes here (`Topic.key`); empty: there is one."""
    _threads: list[threading.Thread] = field(default_factory=list)
    _keep: list[Any] = field(default_factory=list)
    _publishers: dict[str, Any] = field(default_factory=dict)
    _closed: bool = False

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self, timeout_s: float = 1.0) -> None:
        """Close the session and wait for the threads that empty its channels."""
        if self._closed:
            return
        self._closed = True
        self.session.close()  # type: ignore[no-untyped-call]
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout_s)

    def publish(self, topic: Topic[Message], payload: bytes) -> None:
        """Put bytes on a topic; the publisher is declared by the first message or by `declare`.

        What an instance at the base says goes over the link as it is put here: in the compact form.
        """
        self.declare(topic).put(compact(payload) if self.instance == "base" else payload)

    def has_readers(self, topic: Topic[Message]) -> bool:
        """Whether somebody subscribes to a topic (only one that is neither latched nor kept whole can tell)."""
        return bool(self.declare(topic).matching_status.matching)

    def declare(self, topic: Topic[Message]) -> Any:
        """The publisher of a topic. Congestion drops: a blocked reader must never block a writer."""
        publisher = self._publishers.get(topic.name)
        if publisher is None:
            publisher = self._publishers[topic.name] = self._declare(topic)
        return publisher

    def _declare(self, topic: Topic[Message]) -> Any:
        key = topic.key(self.robot, self.instance)
        qos: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": _priority(topic),
            "express": topic.max_bytes <= 256 * 1024,
            "encoding": f"application/msgpack;plgrim/{topic.message.schema_name}.v{topic.message.schema_version}",
        }
        if not _is_advanced(topic):
            return self.session.declare_publisher(key, **qos)
        return ext.declare_advanced_publisher(
            self.session,
            key,
            cache=ext.CacheConfig(max_samples=_cached(topic)),
            publisher_detection=True,
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            **qos,
        )

    def subscribe(
        self,
        topic: Topic[Message],
        receive: Receive,
        every: bool = False,
        instance: str = "",
        recover: bool = True,
    ) -> None:
        """Have a thread of its own call `receive` with each payload of a topic.

        Latest-only topics come through a ring of one: what was not fetched is replaced, never queued. every: queue
        them all the same (for recorders). instance: of two of the writer, what this one says. recover: False takes
        what comes and asks nobody for what was said before or was missed. Exceptions in `receive` are logged and do not
        end the thread.
        """
        channel: Any = (
            zenoh.handlers.FifoChannel(_FIFO) if topic.keep_all or every else zenoh.handlers.RingChannel(1)
        )
        subscriber = self._subscriber(topic, channel, topic.key(self.robot, instance), recover)
        self._keep.append(subscriber)
        self._spawn(f"sub {topic.name}", subscriber.handler, lambda s: receive(topic, s.payload.to_bytes()))

    def _subscriber(self, topic: Topic[Message], channel: Any, key: str, recover: bool) -> Any:
        if not (recover and _is_advanced(topic)):
            return self.session.declare_subscriber(key, channel)
        history: dict[str, Any] = {}
        if topic.period_ns > 0:
            history["history"] = ext.HistoryConfig(detect_late_publishers=True, max_samples=_cached(topic))
        return ext.declare_advanced_subscriber(
            self.session,
            key,
            channel,
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            **history,
        )

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        """Answer every query on a key with `reply()`, from a thread of its own."""
        queryable = self.session.declare_queryable(key, zenoh.handlers.FifoChannel(16))
        self._keep.append(queryable)
        self._spawn(f"query {key}", queryable.handler, lambda q: q.reply(q.key_expr, reply()))

    def serve(self, key: str, reply: Callable[[bytes], bytes]) -> None:
        """Answer every query on a key with `reply(payload)`, each from a thread of its own: a reply may take long.

        What comes while so many are being answered gets an error at once: a flood costs neither memory nor threads.
        """
        queryable = self.session.declare_queryable(key, zenoh.handlers.FifoChannel(16))
        self._keep.append(queryable)
        free = threading.Semaphore(_SERVED_AT_ONCE)

        def work(query: Any) -> None:
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                query.reply(query.key_expr, reply(payload))
            finally:
                del query
                free.release()

        def spawn(query: Any) -> None:
            if not free.acquire(blocking=False):
                query.reply_err(b"busy")
                return
            threading.Thread(target=work, args=(query,), name=f"serve {key}", daemon=True).start()

        self._spawn(f"serve {key}", queryable.handler, spawn)

    def ask(self, key: str, timeout_s: float, payload: bytes | None = None) -> bytes | None:
        """The first good answer to a query, or None: nobody there, refused, or no answer in time."""
        for reply in self.session.get(key, timeout=timeout_s, payload=payload):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
        return None

    def token(self, key: str) -> None:
        """Declare a liveliness token that lives as long as this session."""
        self._keep.append(self.session.liveliness().declare_token(key))

    def tokens(self, expression: str, timeout_s: float = 1.0) -> list[str]:
        """The keys of the living tokens that match."""
        replies = self.session.liveliness().get(expression, timeout=timeout_s)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def _spawn(self, name: str, handler: Any, work: Callable[[Any], None]) -> None:
        thread = threading.Thread(target=_drain, args=(handler, work, name), name=name, daemon=True)
        self._threads.append(thread)
        thread.start()


def _drain(handler: Any, work: Callable[[Any], None], name: str) -> None:
    while True:
        try:
            item = handler.recv()
        except zenoh.ZError:  # the channel is closed: the session has ended
            return
        try:
            work(item)
        except Exception as error:
            get_logger().error("receiving failed", of=name, error=repr(error))
        del item  # a query is finished when it is dropped


def _priority(topic: Topic[Message]) -> zenoh.Priority:
    if topic.max_bytes > _LARGE_BYTES:
        return zenoh.Priority.DATA_LOW
    if topic.name in (
        "reconciler/plan",
        "status/command",
        "mission/state",
        "mission/fences",
        "mission/answer",
    ):
        return zenoh.Priority.INTERACTIVE_HIGH
    return zenoh.Priority.DATA


def connect(
    router: RouterConfig, robot: str, stop: threading.Event, timeout_s: float, process: str = TOOLS
) -> Link:
    """A client session as a Link. process: as who it connects. Raises NoRouterError, CertificateError."""
    return Link(open_session(router, "client", stop, timeout_s, process), robot)
