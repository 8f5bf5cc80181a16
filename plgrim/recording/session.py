"""A recorder as a process: connects, records, ends in order."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path

from plgrim.config import Config
from plgrim.logs import get_logger
from plgrim.missions import world_name
from plgrim.recording.recorder import Recorder
from plgrim.recording.well_known import Translator
from plgrim.recording.writer import Ring, about
from plgrim.runtime.zenoh_session import connect

_LEASE_MS = 20_000


def run_recorder(
    config: Config, folder: Path, stop: threading.Event, segment_s: float, max_bytes: int, raw_only: bool
) -> tuple[Counter[str], Counter[str]]:
    """Record into a folder until `stop`; messages by topic, and lost ones by reason. Raises NoRouterError."""
    ring = Ring(folder, about(config.robot, config.seed, world_name(config)), segment_s, max_bytes)
    # A recorder that a busy machine keeps waiting is not gone.
    patient = config.router.model_copy(update={"lease_ms": max(config.router.lease_ms, _LEASE_MS)})
    link = connect(patient, config.robot, stop, config.runtime.start_timeout_s)
    recorder = Recorder(link, ring, None if raw_only else Translator())
    try:
        recorder.start()
        get_logger().info("records", folder=str(folder))
        while not stop.wait(0.5):
            recorder.tick()
    finally:
        link.close()
        recorder.close()
    get_logger().info("recorded", messages=sum(recorder.counts.values()), lost=dict(recorder.lost))
    return recorder.counts, recorder.lost
