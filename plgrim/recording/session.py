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
from plgrim.runtime.zenoh_session import connect
from plgrim.security.exposure import check_client

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
    check_client(config)
    if base_endpoint:
        check_client(_at(config, base_endpoint))
    ring = Ring(folder, about(config.robot, config.seed, world_name(config)), segment_s, max_bytes)
    # A recorder that a busy machine keeps waiting is not gone.
    patient = config.router.model_copy(update={"lease_ms": max(config.router.lease_ms, _LEASE_MS)})
    link = connect(patient, config.robot, stop, config.runtime.start_timeout_s)
    Offer(folder).on(link.session, config.robot)
    base = _BaseOffer(config, folder, base_endpoint, stop) if base_endpoint else None
    recorder = Recorder(link, ring, None if raw_only else Translator())
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
                with connect(self._router, self._robot, self._ended, 5.0) as link:
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
