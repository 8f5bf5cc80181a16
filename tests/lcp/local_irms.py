"""Local IRMs from small lattices, and the other messages that lcp reads."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.operation import FinishReason, MissionPhase, MissionState
from schemas.policy import EpisodeRequest, GlobalPolicy
from schemas.world import LocalIrm
from tests.planning.coverage_lattices import Reference

IX0, IY0 = -7, 3
"""The lattices of these tests do not begin at the origin."""


def anchor_of(lattice: Reference, node: int) -> tuple[float, float]:
    """Anchors lie off the middle of their patches, each a little differently."""
    column, row = node % lattice.size, node // lattice.size
    return IX0 + column + 0.4 + 0.02 * (row % 5), IY0 + row + 0.6 - 0.03 * (column % 4)


def local_irm(
    lattice: Reference,
    version: int = 1,
    bent: dict[tuple[int, int], Sequence[tuple[float, float]]] | None = None,
) -> LocalIrm:
    """The Local IRM of a lattice with 1 m between nodes. bent: inner points of edges (node, direction < 4)."""
    model, n = lattice.model(), lattice.size**2
    bent = dict(sorted((bent or {}).items()))
    starts = np.concatenate([[0], np.cumsum([len(p) for p in bent.values()])])
    state = np.where((model.edge_distance_m > 0.0).any(axis=1), 1, 2).astype(np.uint8)
    return LocalIrm(
        stamp_ns=0,
        irm_version=version,
        risk_stamp_ns=0,
        spacing_m=1.0,
        ix0=IX0,
        iy0=IY0,
        size=lattice.size,
        robot_pose=Pose(),
        map_to_odom=Pose(),
        sensor_range_m=float(max(lattice.reach, 1)),
        sensor_fov_rad=lattice.fov_rad,
        reach=lattice.reach,
        state=state,
        anchor_m=np.array([anchor_of(lattice, i) for i in range(n)]),
        node_risk=np.zeros(n, np.float32),
        coverage=np.zeros(n, np.float32),
        entropy=lattice.entropy.astype(np.float32),
        edge_distance_m=model.edge_distance_m,
        edge_risk=model.edge_risk,
        bent_edge=np.array([node * 8 + k for node, k in bent], np.int32),
        bent_start=starts.astype(np.int32),
        bent_xy=np.array([xy for p in bent.values() for xy in p], np.float32).reshape(-1, 2),
        visible=lattice.visible(),
    )


def request(
    lattice: Reference,
    node: int,
    heading: int = 0,
    episode: int = 1,
    version: int = 1,
    simulations: int = 256,
    covered: NDArray[np.uint64] | None = None,
    particles: Sequence[tuple[int, int, float]] = (),
) -> EpisodeRequest:
    """An episode request. particles: (node, heading, weight), instead of the one at `node`."""
    belief = particles or [(node, heading, 1.0)]
    return EpisodeRequest(
        stamp_ns=0,
        episode=episode,
        irm_version=version,
        junction_ns=0,
        junction_speed_mps=0.0,
        horizon_m=30.0,
        simulations=simulations,
        particle_node=np.array([p[0] for p in belief], np.int32),
        particle_heading=np.array([p[1] for p in belief], np.uint8),
        particle_weight=np.array([p[2] for p in belief], np.float64),
        covered=np.zeros(lattice.size, np.uint64) if covered is None else covered,
    )


def global_policy(
    path: Sequence[tuple[float, float]],
    map_to_odom: Pose | None = None,
    values: Sequence[tuple[float, float, float]] = (),
    pieces: Sequence[int] | None = None,
) -> GlobalPolicy:
    """A global policy whose target is the end of the path (none for an empty one). values: (x, y, value to go). pieces:
    of the path, by default one.
    """
    target = (*path[-1], 0.0) if path else (0.0, 0.0, 0.0)
    k, n = len(path), len(values)
    return GlobalPolicy(
        stamp_ns=0,
        irm_version=1,
        target=7 if path else -1,
        target_xyz_m=target,
        target_gain=1.0,
        target_q=2.5,
        target_distance_m=math.dist(path[0], path[-1]) if path else 0.0,
        target_risk=0.0,
        switched=False,
        reason="far away" if path else "nothing left to go to",
        alternatives=[],
        map_to_odom=map_to_odom or Pose(),
        node_id=np.arange(n, dtype=np.int64),
        node_xyz_m=np.array([(x, y, 0.0) for x, y, _ in values], np.float64).reshape(-1, 3),
        action=np.full(n, -1, np.int64),
        value=np.array([v for _, _, v in values], np.float64),
        value_to_go=np.array([v for _, _, v in values], np.float64),
        path_node=np.arange(k, dtype=np.int64),
        path_xyz_m=np.array([(x, y, 0.0) for x, y in path], np.float64).reshape(-1, 3),
        path_piece=np.array([0] * k if pieces is None else pieces, np.int32),
        route_xyz_m=np.array([(x, y, 0.0) for x, y in path], np.float64).reshape(-1, 3),
    )


def mission(phase: MissionPhase, now: int = 0) -> MissionState:
    """A mission state in a phase."""
    return MissionState(
        stamp_ns=now,
        phase=phase,
        finish=FinishReason.NONE,
        reason="",
        elapsed_s=0.0,
        time_budget_s=0.0,
        distance_m=0.0,
        return_distance_m=0.0,
        home=Pose(),
        coverage=0.0,
        left=[],
    )
