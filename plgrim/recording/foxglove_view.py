"""Live viewing in Foxglove: the well-known ROS 2 channels of a running system, or of a recording, over a WebSocket.

Needs the extra `foxglove` (foxglove-sdk). docs/foxglove_layout.json is a layout for it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from plgrim.config import Config
from plgrim.errors import PlgrimError, PortTakenError
from plgrim.logs import get_logger
from plgrim.recording.envelope import definition, to_cdr
from plgrim.recording.reader import read_raw
from plgrim.recording.well_known import Shown, Translator
from plgrim.runtime.router import check_port_free
from plgrim.runtime.zenoh_session import connect
from plgrim.security.exposure import check_client
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import SECOND_NS, Topic
from schemas.errors import MessageError
from schemas.topics import SERVICES, TOPICS, health_topic, topic_named


class FoxgloveServer:
    """A Foxglove WebSocket server with a channel a topic. Raises PortTakenError, and PlgrimError without the extra.

    Its protocol has neither TLS nor tokens here: check the address first (`check_listen`).
    """

    def __init__(self, host: str, port: int) -> None:
        self._sdk = _sdk()
        check_port_free(host, port, "choose another with --port")
        self._channels: dict[str, Any] = {}
        self._lock = threading.Lock()
        try:
            self._server = self._sdk.start_server(name="PLGRIM", host=host, port=port)
        except RuntimeError as error:
            raise PortTakenError(
                f"port {port} on {host} cannot be used ({error}): choose another with --port"
            ) from error
        self.port = int(self._server.port)

    def show(self, shown: Shown, stamp_ns: int) -> None:
        """Send a ROS message to whoever looks on."""
        topic, message = shown
        with self._lock:
            if topic not in self._channels:
                kind = message.__msgtype__
                schema = self._sdk.Schema(name=kind, encoding="ros2msg", data=definition(kind).encode())
                self._channels[topic] = self._sdk.Channel(topic, message_encoding="cdr", schema=schema)
            self._channels[topic].log(to_cdr(message), log_time=stamp_ns)

    def close(self) -> None:
        """End it."""
        self._server.stop()
        for channel in self._channels.values():
            channel.close()


def _sdk() -> Any:
    try:
        import foxglove
    except ImportError as error:
        raise PlgrimError("foxglove-sdk is not installed: pip install 'plgrim[foxglove]'") from error
    return foxglove


def show_live(config: Config, server: FoxgloveServer, stop: threading.Event) -> None:
    """Show a running system until `stop`. Raises NoRouterError."""
    translate = Translator()
    lock = threading.Lock()

    def receive(topic: Topic[Message], payload: bytes) -> None:
        try:
            message, _ = decode(payload, topic.message, topic.max_bytes)
        except MessageError as error:
            get_logger().warning("message refused", topic=topic.name, reason=str(error))
            return
        with lock:
            shown = translate(message)
        for one in shown:
            server.show(one, message.stamp_ns)

    check_client(config)
    with connect(config.router, config.robot, stop, config.runtime.router_timeout_s) as link:
        for topic in (*TOPICS, *(health_topic(service) for service in SERVICES)):
            link.subscribe(topic, receive)
        while not stop.wait(0.5):
            pass


def show_recording(
    path: Path, server: FoxgloveServer, stop: threading.Event, speed: float, warn: Callable[[str], None]
) -> None:
    """Show a recording at a speed (mission seconds a wall second). Raises RecordingError."""
    translate = Translator()
    began_s: float | None = None
    for raw in read_raw(path, warn, lambda name: not name.endswith(("/steps", "/snapshot"))):
        topic = topic_named(raw.topic)
        message, _ = decode(raw.payload, topic.message, topic.max_bytes)
        at_s = raw.sent_ns / SECOND_NS / speed
        began_s = time.monotonic() - at_s if began_s is None else began_s
        if stop.wait(max(0.0, began_s + at_s - time.monotonic())):
            return
        for one in translate(message):
            server.show(one, message.stamp_ns)
