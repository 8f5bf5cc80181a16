"""A robot and a base station in small: `python -m tests.link.fakes NAME ...` runs some of it over Zenoh.

`sim`, `irm` and `mission` say something at their periods; `gcp` answers as the real one does: from the newest odometry
and graph, and asks for the whole graph when a difference was missed.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from plgrim.config import Config, load_config
from plgrim.errors import PlgrimError
from plgrim.logs import configure_logs
from plgrim.runtime.live import drive
from plgrim.runtime.process import die_with_parent, stop_on_signals
from plgrim.runtime.zenoh_session import connect
from schemas.base import Message, Pose
from schemas.codec import decode
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSpec, Stamp, Topic
from schemas.operation import (
    CommandKind,
    FinishReason,
    JudgeReport,
    LinkReport,
    MissionCommand,
    MissionState,
)
from schemas.policy import GlobalPolicy
from schemas.topics import (
    COMMAND,
    GCP_GRAPH_REQUEST,
    GLOBAL_IRM,
    GLOBAL_POLICY,
    MISSION,
    ODOMETRY,
    RISK_MAP,
    STATUS_GRAPH_REQUEST,
    topic_named,
)
from schemas.world import GlobalIrm, GraphRequest, GridHeader, RiskMap
from tests.runtime.fake_services import mission_state, odometry

MAP_CELLS = 126
NODES_A_STEP = 5


def global_irm(now: Stamp, version: int, base: int) -> GlobalIrm:
    """The graph of a version, whole or as the difference to the one before: five breadcrumbs come with each."""
    first = 1 if base == 0 else base * NODES_A_STEP + 1
    ids = np.arange(first, version * NODES_A_STEP + 1, dtype=np.int64)
    nothing = np.empty(0, np.int64)
    return GlobalIrm(
        stamp_ns=now,
        irm_version=version,
        base_version=base,
        robot_pose=Pose(),
        map_to_odom=Pose(),
        robot_node=1,
        node_id=ids,
        node_kind=np.zeros(ids.size, np.uint8),
        node_xyz_m=np.column_stack((ids, ids, 0 * ids)).astype(np.float64),
        node_gain=np.zeros(ids.size),
        node_coverage=np.zeros(ids.size, np.float32),
        edge_a=nothing,
        edge_b=nothing,
        edge_distance_m=np.empty(0),
        edge_risk=np.empty(0),
        edge_driven=np.empty(0, np.uint8),
        removed_node=nothing,
        removed_edge=np.empty((0, 2), np.int64),
    )


def global_policy(now: Stamp, version: int, target: int = -1) -> GlobalPolicy:
    """A policy that says which graph it was made from."""
    return GlobalPolicy(
        stamp_ns=now,
        irm_version=version,
        target=target,
        target_xyz_m=(0.0, 0.0, 0.0),
        target_gain=0.0,
        target_q=0.0,
        target_distance_m=0.0,
        target_risk=0.0,
        switched=False,
        reason="fake",
        alternatives=[],
        map_to_odom=Pose(),
        node_id=np.empty(0, np.int64),
        node_xyz_m=np.empty((0, 3)),
        action=np.empty(0, np.int64),
        value=np.empty(0),
        value_to_go=np.empty(0),
        path_node=np.empty(0, np.int64),
        path_xyz_m=np.empty((0, 3)),
        path_piece=np.empty(0, np.int32),
        route_xyz_m=np.empty((0, 3)),
    )


class _Memoryless:
    def snapshot(self) -> bytes:
        return b""

    def restore(self, snapshot: bytes) -> None:
        del snapshot


class Sim(_Memoryless):
    """Odometry at 20 Hz."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One message."""
        del inputs
        return [Output(ODOMETRY, odometry(now, now / SECOND_NS))]


class Irm(_Memoryless):
    """A graph that grows at 2 Hz; the whole of it when asked."""

    def __init__(self) -> None:
        self._version = 0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One difference, or the whole graph."""
        asked = [*inputs.new(GCP_GRAPH_REQUEST), *inputs.new(STATUS_GRAPH_REQUEST)]
        self._version += 1
        base = 0 if asked or self._version == 1 else self._version - 1
        return [Output(GLOBAL_IRM, global_irm(now, self._version, base))]


class Mission(_Memoryless):
    """A state at 2 Hz."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One message."""
        del inputs
        return [Output(MISSION, mission_state(now, 0, FinishReason.NONE))]


class Gcp(_Memoryless):
    """A policy at each message of the graph; the target is its number of nodes. It asks when a difference is missed."""

    def __init__(self) -> None:
        self._version = 0

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """A policy once there is a graph, and a request when a difference was missed."""
        fits = True
        for received in inputs.new(GLOBAL_IRM):
            fits = received.message.base_version in (0, self._version)
            self._version = received.message.irm_version if fits else self._version
        request = GraphRequest(stamp_ns=now, have_version=self._version)
        asks = [] if fits else [Output(GCP_GRAPH_REQUEST, request)]
        inputs.current(MISSION)
        if inputs.current(ODOMETRY) is None or self._version == 0:
            return [*asks]
        return [Output(GLOBAL_POLICY, global_policy(now, self._version, self._version)), *asks]


class Maps(_Memoryless):
    """Risk maps at 4 Hz that take about 100 kB on the link, for they are noise."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(1)

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One map."""
        del inputs
        return [Output(RISK_MAP, risk_map(now, self._rng, MAP_CELLS))]


def risk_map(now: Stamp, rng: np.random.Generator, cells: int) -> RiskMap:
    """A square risk map of noise."""
    shape = (cells, cells)
    layers = {
        name: rng.uniform(0.0, 5.0, shape).astype(np.float32)
        for name in ("hazard_mean", "hazard_variance", "hazard_cvar", "clearance_m", "elevation_m", "top_m")
    }
    grid = GridHeader(resolution_m=0.2, ix0=0, iy0=0, width=cells, height=cells)
    state = rng.integers(0, 3, shape).astype(np.uint8)
    return RiskMap(stamp_ns=now, grid=grid, robot_pose=Pose(), footprint_radius_m=0.5, state=state, **layers)


class Operator(_Memoryless):
    """A command at 5 Hz, and nothing else of what status does."""

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """One command."""
        del inputs
        command = MissionCommand(stamp_ns=now, command_id=str(now), kind=CommandKind.PAUSE)
        return [Output(COMMAND, command)]


def make(name: str) -> tuple[StageSpec, Stage]:
    """The fake of a service's name."""
    made: dict[str, Callable[[], tuple[StageSpec, Stage]]] = {
        "sim": lambda: (StageSpec("sim", SECOND_NS // 20), Sim()),
        "irm": lambda: (StageSpec("irm", SECOND_NS // 2, (GCP_GRAPH_REQUEST.name,)), Irm()),
        "mission": lambda: (StageSpec("mission", SECOND_NS // 2), Mission()),
        "gcp": lambda: (StageSpec("gcp", SECOND_NS, (GLOBAL_IRM.name,)), Gcp()),
        "riskmap": lambda: (StageSpec("riskmap", SECOND_NS // 4), Maps()),
        "status": lambda: (StageSpec("status", SECOND_NS // 5), Operator()),
    }
    return made[name]()


def observe(config: Config, stop: threading.Event, path: str, names: list[str]) -> None:
    """Write a line for each message: time of receipt (monotonic ns), topic, epoch, sequence, sent_ns, more."""
    with open(path, "w", encoding="ascii") as file, connect(config.router, config.robot, stop, 120.0) as link:
        lock = threading.Lock()

        def receive(topic: Topic[Message], payload: bytes) -> None:
            now_ns = time.monotonic_ns()
            message, envelope = decode(payload, topic.message, topic.max_bytes)
            more: Any = None
            if isinstance(message, GlobalPolicy):
                more = [message.irm_version, message.target]
            elif isinstance(message, LinkReport | MissionState | JudgeReport):
                more = message.model_dump(mode="json")
            line = [now_ns, topic.name, envelope.epoch, envelope.sequence, envelope.sent_ns, more]
            with lock:
                file.write(json.dumps(line) + "\n")
                file.flush()

        for name in names:
            link.subscribe(topic_named(name), receive, every=True)
        stop.wait()


def main() -> None:
    """Run fakes in threads until SIGTERM; `router` and `link` are the real ones, `observe:FILE:TOPIC,...` writes."""
    from plgrim.link.process import run_link
    from plgrim.runtime.router import run_router

    die_with_parent()
    configure_logs("+".join(sys.argv[1:])[:40])
    config = load_config()
    with stop_on_signals() as stop:
        event = threading.Event()

        def run(name: str) -> None:
            try:
                if name == "router":
                    run_router(config, event)
                elif name == "link":
                    run_link(config, event)
                elif name.startswith("observe:"):
                    _, path, topics = name.split(":")
                    observe(config, event, path, topics.split(","))
                else:
                    drive(name, config, lambda: make(name), event)
            except PlgrimError as error:
                print(f"fake {name}: {error}", file=sys.stderr)

        threads = [threading.Thread(target=run, args=(name,)) for name in sys.argv[1:]]
        for thread in threads:
            thread.start()
        stop.wait()
        event.set()
        for thread in threads:
            thread.join()


if __name__ == "__main__":
    main()
