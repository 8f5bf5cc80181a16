"""A robot and a base station in small, as processes: `python -m tests.link.fakes NAME` runs one over Zenoh.

`sim`, `irm` and `mission` say something at their periods; `gcp` answers as the real one does: from the newest odometry
and graph, and asks for the whole graph when a difference was missed.
"""

from __future__ import annotations

import sys

import numpy as np

from planning.graph_mirror import GraphMirror
from plgrim.config import load_config
from plgrim.errors import PlgrimError
from plgrim.logs import configure_logs
from plgrim.runtime.live import drive
from plgrim.runtime.process import die_with_parent, stop_on_signals
from schemas.base import Pose
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Stage, StageSpec, Stamp
from schemas.operation import FinishReason
from schemas.policy import GlobalPolicy
from schemas.topics import GCP_GRAPH_REQUEST, GLOBAL_IRM, GLOBAL_POLICY, MISSION, ODOMETRY, STATUS_GRAPH_REQUEST
from schemas.world import GlobalIrm, GraphRequest
from tests.runtime.fake_services import mission_state, odometry

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
    """A policy each second; the target is the number of nodes known."""

    def __init__(self) -> None:
        self._mirror = GraphMirror()

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """A policy once there is a graph, and a request when a difference was missed."""
        fits = all([self._mirror.apply(received.message) for received in inputs.new(GLOBAL_IRM)])
        asks = [] if fits else [Output(GCP_GRAPH_REQUEST, GraphRequest(stamp_ns=now, have_version=self._mirror.version))]
        inputs.current(MISSION)
        if inputs.current(ODOMETRY) is None or self._mirror.version == 0:
            return [*asks]
        nodes = int(self._mirror.road_map().node_id.size)
        return [Output(GLOBAL_POLICY, global_policy(now, self._mirror.version, nodes)), *asks]


def make(name: str) -> tuple[StageSpec, Stage]:
    """The fake of a service's name."""
    made: dict[str, tuple[StageSpec, Stage]] = {
        "sim": (StageSpec("sim", SECOND_NS // 20), Sim()),
        "irm": (StageSpec("irm", SECOND_NS // 2, (GCP_GRAPH_REQUEST.name,)), Irm()),
        "mission": (StageSpec("mission", SECOND_NS // 2), Mission()),
        "gcp": (StageSpec("gcp", SECOND_NS, (GLOBAL_IRM.name,)), Gcp()),
    }
    return made[name]


def main() -> None:
    """Run one until SIGTERM; `router` and `link` are the real ones."""
    from plgrim.link.process import run_link
    from plgrim.runtime.router import run_router

    name = sys.argv[1]
    die_with_parent()
    configure_logs(name)
    config = load_config()
    with stop_on_signals() as stop:
        try:
            if name == "router":
                run_router(config.router, stop)
            elif name == "link":
                run_link(config, stop)
            else:
                drive(name, config, lambda: make(name), stop)
        except PlgrimError as error:
            print(f"fake: {error}", file=sys.stderr)
            sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
