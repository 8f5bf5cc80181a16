"""Whole missions: live with all services as processes, in lock-step, or watched from outside; each gives a result."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from planning.robot_profile import PROFILES
from plgrim.config import Config, service_config_class
from plgrim.evaluation.recorder import RECORDED, MissionRecorder, quantile
from plgrim.logs import get_logger
from plgrim.progress import MissionProgress
from plgrim.registry import STAGES
from plgrim.runtime.router import page_address
from plgrim.runtime.supervisor import Command, Supervisor, plgrim_command
from plgrim.runtime.zenoh_session import Link, connect
from plgrim.security.exposure import check_client
from plgrim.security.local_token import page_to_print, with_local_token
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import SECOND_NS, Topic
from schemas.errors import MessageError
from schemas.topics import SERVICES

Result = dict[str, Any]
_LAST_WORDS_S = 6.0
_LOST_GRACE_S = 5.0


def world_name(config: Config) -> str:
    """The world or map that the simulator is told to use, for titles and results."""
    for key in ("map_file", "mesh_file", "dem_file"):
        if config.sim.get(key):
            return Path(str(config.sim[key])).stem
    if "world" in config.sim:
        return str(config.sim["world"])
    model = service_config_class("sim")
    return str(model.model_fields["world"].default) if model and "world" in model.model_fields else "-"


def status_address(config: Config) -> tuple[str, int]:
    """Host and port of the status service."""
    model = service_config_class("status")
    fields = model.model_fields if model else {}
    host = config.status.get("host", fields["host"].default if "host" in fields else "127.0.0.1")
    port = config.status.get("port", fields["port"].default if "port" in fields else 8080)
    return str(host), int(port)


def status_page(config: Config) -> str:
    """Address of the status page as a person on this host opens it."""
    return page_address(*status_address(config), secure=bool(config.status.get("tls_certificate_file")))


def attach_recorder(link: Link, recorder: MissionRecorder) -> None:
    """Have the recorder observe everything it needs over a link."""

    def receive(topic: Topic[Message], payload: bytes) -> None:
        try:
            message, envelope = decode(payload, topic.message, topic.max_bytes)
        except MessageError as error:
            get_logger().warning("recorder: message refused", topic=topic.name, reason=str(error))
            return
        recorder.observe(topic, message, envelope.sent_ns, envelope.epoch)

    for topic in RECORDED:
        link.subscribe(topic, receive, every=True)


def run_live(
    config: Config,
    out_dir: Path,
    stop: threading.Event,
    console: Console,
    until_end: bool = True,
    services: tuple[str, ...] = SERVICES,
    command: Command = plgrim_command,
    resume: bool = False,
) -> Result:
    """Run all services as processes until the mission ends or `stop`; write and give the result.

    until_end: False goes on after the mission's end. resume: with the state that the configuration names.
    Raises PlgrimError when the services cannot run.
    """
    recorder = MissionRecorder(config.seed, world_name(config), "live", config.clock.speed)
    out_dir.mkdir(parents=True, exist_ok=True)
    config = with_local_token(config, out_dir)
    page = status_page(config) if "status" in services else ""
    began = time.monotonic()
    with (
        Supervisor(config, out_dir, services, command, resume) as supervisor,
        MissionProgress(
            recorder, page and page_to_print(page, config, out_dir, console.file), console
        ) as progress,
    ):
        link = supervisor.start()
        attach_recorder(link, recorder)
        if supervisor.wait_ready(stop, progress.waiting):
            _follow(recorder, stop, progress.update, supervisor.poll, until_end)
        supervisor.finished = recorder.finished or recorder.lost
        recorder.restarts = {c.name: c.restarted for c in supervisor.children.values() if c.restarted}
    return recorder.write(out_dir, extra={"wall_s": round(time.monotonic() - began, 1)})


def watch(config: Config, out_dir: Path, stop: threading.Event, console: Console) -> Result:
    """Join a running system as one more client, follow the mission to its end, write and give the result."""
    check_client(config)
    recorder = MissionRecorder(config.seed, world_name(config), "live", config.clock.speed)
    began = time.monotonic()
    with (
        connect(config.router, config.robot, stop, config.runtime.start_timeout_s) as link,
        MissionProgress(recorder, "", console) as progress,
    ):
        attach_recorder(link, recorder)
        _follow(recorder, stop, progress.update, lambda: None, True)
    return recorder.write(out_dir, extra={"wall_s": round(time.monotonic() - began, 1)})


def _follow(
    recorder: MissionRecorder,
    stop: threading.Event,
    update: Callable[[], None],
    poll: Callable[[], None],
    until_end: bool,
) -> None:
    """Until the mission ends, the robot has been lost for a while, or `stop`; then wait for the last words."""
    lost_since: float | None = None
    while not stop.wait(0.1):
        poll()
        update()
        if recorder.lost:
            lost_since = lost_since or time.monotonic()
        is_lost = lost_since is not None and time.monotonic() - lost_since > _LOST_GRACE_S
        if until_end and (recorder.finished or is_lost):
            _last_words(recorder, stop, update)
            return


def _last_words(recorder: MissionRecorder, stop: threading.Event, update: Callable[[], None]) -> None:
    """Wait for a judgement and a picture from after the end, so that the result shows the end."""
    ended_ns = recorder.mission.stamp_ns if recorder.mission else 0
    deadline = time.monotonic() + _LAST_WORDS_S
    while time.monotonic() < deadline and not stop.wait(0.1):
        update()
        judge, picture = recorder.judge, recorder.picture
        if judge and picture and min(judge.stamp_ns, picture.stamp_ns) >= ended_ns:
            return


def run_lockstep(
    config: Config,
    out_dir: Path,
    console: Console,
    limit_s: float = 0.0,
    each_second: Callable[[MissionRecorder], None] | None = None,
) -> Result:
    """Run the mission in this process under a virtual clock, as fast as the machine can; write and give the result.

    limit_s: stop after so much mission time, in whole seconds (0: the mission's own end). Ctrl-C ends it early,
    with a result. each_second: called after every second of mission time, to watch from outside.
    """
    from plgrim.runtime.lockstep import Lockstep

    recorder = MissionRecorder(config.seed, world_name(config), "lockstep")
    options = {name: config.options(name) for name in STAGES}
    lockstep = Lockstep(options, config.seed, config.robot, recorder.observe)
    recorder.changes.footprint_radius_m = PROFILES[config.profile].footprint_radius_m
    recorder.changes.closed = getattr(lockstep.stage("sim"), "closed_areas_m", tuple)
    began = time.monotonic()
    lost_ns = 0
    with MissionProgress(recorder, "", console) as progress:
        try:
            while not recorder.finished and not (limit_s and lockstep.now >= limit_s * SECOND_NS):
                lockstep.run_until(lockstep.now + SECOND_NS)
                progress.update()
                if each_second is not None:
                    each_second(recorder)
                lost_ns += SECOND_NS if recorder.lost else 0
                if lost_ns > _LOST_GRACE_S * SECOND_NS:
                    break
            end = lockstep.now + int(_LAST_WORDS_S) * SECOND_NS
            lockstep.run_until(max(lockstep.now, min(end, int(limit_s * SECOND_NS))) if limit_s else end)
        except KeyboardInterrupt:
            console.print("interrupted: writing the result so far")
    wall_s = time.monotonic() - began
    extra = {
        "wall_s": round(wall_s, 1),
        "times_real_time": lockstep.now / SECOND_NS / max(wall_s, 1e-9),
        "digest": lockstep.digest(),
        "dropped": lockstep.dropped(),
        "answers": {name: _milliseconds(s) for name, s in lockstep.answer_seconds().items() if s},
    }
    return recorder.write(out_dir, lockstep.step_seconds(), extra)


def _milliseconds(seconds: list[float]) -> Result:
    """How many steps, and quantiles of their wall time."""
    p50, p99 = quantile(seconds, 0.5), quantile(seconds, 0.99)
    return {"count": len(seconds), "p50_ms": 1e3 * (p50 or 0.0), "p99_ms": 1e3 * (p99 or 0.0)}
