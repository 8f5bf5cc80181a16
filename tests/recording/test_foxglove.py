"""The Foxglove server, by a WebSocket client of its protocol; and its layout."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
from typing import Any

import pytest
import websockets

from plgrim.recording.foxglove_view import FoxgloveServer, show_recording
from plgrim.recording.well_known import Translator
from schemas.codec import decode
from schemas.topics import topic_named
from tests.recording.conftest import Short
from tests.runtime.helpers import REPOSITORY

pytest.importorskip("foxglove", reason="the extra `foxglove` is not installed")


async def _look(port: int, wanted: str) -> tuple[set[str], bytes]:
    """The topics that are offered, and the first message of one."""
    address = f"ws://127.0.0.1:{port}"
    protocols: Any = ["foxglove.sdk.v1", "foxglove.websocket.v1"]
    async with websockets.connect(address, subprotocols=protocols, max_size=None) as socket:
        offered: dict[str, dict[str, Any]] = {}
        while True:
            received = await asyncio.wait_for(socket.recv(), 60.0)
            if isinstance(received, bytes):
                assert received[0] == 1  # message data: subscription, log time, content
                assert struct.unpack("<I", received[1:5]) == (7,)
                return set(offered), received[13:]
            said = json.loads(received)
            if said["op"] == "advertise":
                offered.update({channel["topic"]: channel for channel in said["channels"]})
                if wanted in offered:
                    channel = offered[wanted]
                    assert (channel["encoding"], channel["schemaName"]) == ("cdr", "nav_msgs/msg/Odometry")
                    subscription = {"id": 7, "channelId": channel["id"]}
                    await socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))


def test_a_client_of_the_protocol_gets_what_a_recording_shows(short: Short, free_port: int) -> None:
    server = FoxgloveServer("127.0.0.1", free_port)
    stop = threading.Event()

    def play() -> None:
        while not stop.is_set():  # again and again, until the client has seen one
            show_recording(short.folder, server, stop, 4.0, lambda _: None)

    thread = threading.Thread(target=play)
    thread.start()
    try:
        topics, content = asyncio.run(_look(server.port, "/plgrim/odometry"))
    finally:
        stop.set()
        thread.join()
        server.close()
    assert "/plgrim/odometry" in topics
    assert len(content) > 300


def test_the_layout_names_channels_that_there_are(short: Short) -> None:
    layout = json.loads((REPOSITORY / "docs" / "foxglove_layout.json").read_text(encoding="utf-8"))
    translate = Translator()
    there = {"/plgrim/keyframes", "/plgrim/events", "/plgrim/target", "/plgrim/global_path"}
    for raw in short.raws:
        topic = topic_named(raw.topic)
        there |= {name for name, _ in translate(decode(raw.payload, topic.message, topic.max_bytes)[0])}
    text = json.dumps(layout["configById"])
    named = {
        word.split(".")[0]
        for word in text.replace('"', " ").replace(",", " ").split()
        if word.startswith("/")
    }
    assert named <= there, named - there
