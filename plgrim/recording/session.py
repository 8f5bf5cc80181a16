"""A recorder as a process: connects, records, ends in order."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path

from plgrim.config import Config
from plgrim.errors import NoRouterError
from plgrim.logs import get_logger
from plgrim.missions import world_name
from plgrim.recording.recorder import Recorder
from plgrim.recording.transfer import Fetcher, Offer
from plgrim.recording.well_known import Translator
from plgrim.recording.writer import Ring, about
from plgrim.runtime.health import HealthMonitor, query_key
from plgrim.runtime.zenoh_session import connect, many_receivers
from plgrim.security.access import RECORDER
from plgrim.security.exposure import check_client
from schemas.codec import Envelope, encode

_LEASE_MS = 20_000


def run_recorder(
    config: Config,
    folder: Path,
    stop: threading.Event,
    segment_s: float,
    max_bytes: int,
    raw_only: bool,
    base_endpoint: str = "",
) -> tuple[Counter[str], Counter[str]]:
    """Record into a folder until `stop`; messages by topic, and lost ones by reason.

    base_endpoint: of the base station's router, where the segments are offered too. Raises NoRouterError, ConfigError.
    """
    check_client(config, RECORDER)
    if base_endpoint:
        check_client(_at(config, base_endpoint), RECORDER)
    many_receivers()
    ring = Ring(folder, about(config.robot, config.seed, world_name(config)), segment_s, max_bytes)
    # A recorder that a busy machine keeps waiting is not gone.
    patient = config.router.model_copy(update={"lease_ms": max(config.router.lease_ms, _LEASE_MS)})
    link = connect(patient, config.robot, stop, config.runtime.start_timeout_s, RECORDER)
    if config.link.host != "base":  # there they lie already, and the robot's would be taken for them
        Offer(folder).on(link.session, config.robot)
    base = _BaseOffer(config, folder, base_endpoint, stop) if base_endpoint else None
    recorder = Recorder(link, ring, None if raw_only else Translator(), config.link.instance)
    health = _Health(config, recorder)
    link.answer(query_key(config.robot, f"{recorder_instance(config)}/{RECORDER}".lstrip("/")), health.answer)
    try:
        recorder.start()
        get_logger().info("records", folder=str(folder))
        while not stop.wait(0.5):
            recorder.tick()
    finally:
        if base is not None:
            base.join(5.0)
        link.close()
        recorder.close()
    get_logger().info("recorded", messages=sum(recorder.counts.values()), lost=dict(recorder.lost))
    return recorder.counts, recorder.lost


def recorder_instance(config: Config) -> str:
    """`base` for the base's recorder: the robot's may be heard at the same router."""
    return "base" if config.link.host == "base" else ""


class _Health:
    """Answers health checks: ready while the disk takes what comes. steps: messages written."""

    def __init__(self, config: Config, recorder: Recorder) -> None:
        self._robot, self._recorder, self._asked = config.robot, recorder, 0
        self._monitor = HealthMonitor(RECORDER)

    def answer(self) -> bytes:
        """The health of this moment, as a message."""
        recorder, monitor = self._recorder, self._monitor
        self._asked += 1
        monitor.steps = sum(recorder.counts.values())
        monitor.ready, monitor.last_error = not recorder.ring.trouble, recorder.ring.trouble[:500]
        health = monitor.report(0, dict(recorder.lost), [])
        return encode(health, Envelope(self._robot, RECORDER, 1, self._asked, 0))


def _at(config: Config, endpoint: str) -> Config:
    """The configuration for a client of another router."""
    return config.model_copy(update={"router": config.router.model_copy(update={"connect": endpoint})})


class _BaseOffer(threading.Thread):
    """Offers a folder at the base's router, over a session of its own that waits for the base as long as it takes."""

    def __init__(self, config: Config, folder: Path, endpoint: str, stop: threading.Event) -> None:
        super().__init__(name="base offer", daemon=True)
        self._router = _at(config, endpoint).router
        self._robot, self._folder, self._ended = config.robot, folder, stop
        self.start()

    def run(self) -> None:
        """Connect when the base is there; Zenoh connects again after a cut."""
        while not self._ended.is_set():
            try:
                with connect(self._router, self._robot, self._ended, 5.0, RECORDER) as link:
                    Offer(self._folder).on(link.session, self._robot)
                    self._ended.wait()
            except NoRouterError:
                self._ended.wait(1.0)


def run_fetch(
    config: Config, folder: Path, stop: threading.Event, kilobytes_per_s: float, once: bool
) -> tuple[int, int]:
    """Fetch segments until `stop`, or until all are there; how many were fetched, and how many are still missing.

    Raises NoRouterError.
    """
    check_client(config)
    folder.mkdir(parents=True, exist_ok=True)
    missing = -1
    with connect(config.router, config.robot, stop, config.runtime.router_timeout_s) as link:
        fetcher = Fetcher(link, folder, kilobytes_per_s)
        while not stop.is_set():
            missing = fetcher.round(stop)
            if once and missing == 0:
                break
            stop.wait(2.0)
    return fetcher.fetched, missing
