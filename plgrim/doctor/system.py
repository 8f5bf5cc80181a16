"""A running system: does the router answer, which services live, what they wait for, and who should have sent it."""

from __future__ import annotations

import threading
import time

from plgrim.config import Config
from plgrim.doctor.finding import Finding, Level
from plgrim.errors import NoRouterError
from plgrim.runtime.zenoh_session import Link, connect
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import Topic
from schemas.errors import MessageError
from schemas.operation import StageHealth
from schemas.topics import SERVICES, health_topic, topic_named


def system(config: Config, listen_s: float) -> tuple[bool, list[Finding]]:
    """Whether a router answers, and what its services say within `listen_s` wall seconds."""
    try:
        link = connect(config.router, config.robot, threading.Event(), 1.5)
    except NoRouterError as error:
        return False, [
            Finding("router", "warning", str(error), "nothing runs yet? then: plgrim up, or make demo")
        ]
    with link:
        health, others = listen(link, listen_s)
    found = [Finding("router", "ok", f"answers at {config.router.client_endpoint}")]
    if not health:
        says = f"no service of robot {config.robot!r} is heard"
        mend = "start them (plgrim up), or name the robot with PLGRIM_ROBOT"
        if others:
            says += f"; heard are {', '.join(sorted(others))}"
        return True, [*found, Finding("services", "warning", says, mend)]
    return True, [*found, *(service_finding(name, health) for name in SERVICES)]


def listen(link: Link, listen_s: float) -> tuple[dict[str, StageHealth], set[str]]:
    """The newest health of each service, and the names of other robots that are heard."""
    health: dict[str, StageHealth] = {}

    def hear(topic: Topic[Message], payload: bytes) -> None:
        try:
            message, _ = decode(payload, topic.message, topic.max_bytes)
        except MessageError:
            return
        if isinstance(message, StageHealth):
            health[message.service] = message

    for service in SERVICES:
        link.subscribe(health_topic(service), hear)
    others = {key.split("/")[2] for key in link.tokens("plgrim/@v1/*/*/alive/*") if key.count("/") >= 4}
    deadline = time.monotonic() + listen_s
    while time.monotonic() < deadline and len(health) < len(SERVICES):
        time.sleep(0.05)
    return dict(health), others - {link.robot}


def service_finding(name: str, health: dict[str, StageHealth]) -> Finding:
    """How a service is, and for want of what."""
    one = health.get(name)
    if one is None:
        return Finding(
            name, "error", "is not heard", f"plgrim run {name}, or see logs/{name}.log in the run's folder"
        )
    if not one.ready:
        return Finding(name, "error", f"not ready: {one.last_error or 'starting'}", f"see logs/{name}.log")
    if one.waiting_for:
        says = f"waits for {', '.join(one.waiting_for)}"
        return Finding(name, "warning", says, "; ".join(_why(topic, health) for topic in one.waiting_for))
    errors = f", {one.errors} errors, last: {one.last_error}" if one.errors else ""
    dropped = f", refused {sum(one.dropped.values())}" if one.dropped else ""
    level: Level = "warning" if one.errors else "ok"
    mend = f"see logs/{name}.log" if one.errors else ""
    return Finding(
        name, level, f"{one.rate_hz:.1f} steps/s, p99 {one.step_p99_ms:.0f} ms{errors}{dropped}", mend
    )


def _why(topic: str, health: dict[str, StageHealth]) -> str:
    """Who should have sent a topic, and how that one is."""
    writer = topic_named(topic).writer
    one = health.get(writer)
    if one is None:
        return f"{topic} comes from {writer}, which is not heard: start it"
    if one.waiting_for:
        return f"{topic} comes from {writer}, which itself waits for {', '.join(one.waiting_for)}"
    if not one.ready:
        return f"{topic} comes from {writer}, which is not ready"
    return f"{topic} comes from {writer}, which runs: see its log"
