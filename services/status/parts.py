"""The live page's parts: what each message becomes for a browser. Arrays little-endian, as bytes; places in metres.

A part is a map of numbers, text and bytes; the page's `store.js` reads them by these names. What lies in `odom` stays
there: the page turns it by `pose.frame`, so that a loop closure needs no new risk map.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.graph_mirror import FRONTIER, RoadMap
from schemas.fences import Fences
from schemas.policy import GlobalPolicy, Plan
from schemas.sensing import Odometry
from schemas.world import LocalIrm, RiskMap

RISK_FULL_PER_M = 2.0
"""Hazard rate that is drawn as the highest, 1/m."""
_UNKNOWN, _LETHAL, _STEPS = 0, 255, 253
CHUNK_IDS = 512
"""Ids of Global IRM nodes in one part: a difference of the graph is a few small parts."""

Part = dict[str, Any]


def raw(values: NDArray[Any], dtype: str) -> bytes:
    """The values as little-endian bytes of that type."""
    return np.ascontiguousarray(values, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()


def squeeze(cells: NDArray[np.uint8]) -> bytes:
    """Cells deflated (zlib's format): once, here, and not once for each browser."""
    return zlib.compress(np.ascontiguousarray(cells).tobytes(), 1)


def pose_part(odometry: Odometry, x_m: float, y_m: float, yaw_rad: float) -> Part:
    """Where the robot is in `map`, how surely (covariance of x and y), and where `odom` lies in `map`."""
    frame, covariance = odometry.map_to_odom, odometry.covariance
    return {
        "x": x_m,
        "y": y_m,
        "yaw": yaw_rad,
        "speed": odometry.speed_mps,
        "frame": [frame.x_m, frame.y_m, frame.yaw_rad],
        "cov": [float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])],
        "yaw_var": float(covariance[2, 2]),
        "stamp_s": odometry.stamp_ns / 1e9,
    }


def risk_code(state: NDArray[np.uint8], hazard: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(h, w): 0 unknown, 255 lethal, else 1..254: 1 + 253 sqrt(hazard / RISK_FULL_PER_M), fine where it is low."""
    share = np.sqrt(np.minimum(hazard, RISK_FULL_PER_M) / RISK_FULL_PER_M)
    code = (1.5 + _STEPS * share).astype(np.uint8)
    code[state == 0] = _UNKNOWN
    code[state == 2] = _LETHAL
    return code


def risk_part(risk: RiskMap) -> Part:
    """The risk map (CVaR of the hazard rate), one byte a cell."""
    grid = risk.grid
    return {
        "res": grid.resolution_m,
        "ix0": grid.ix0,
        "iy0": grid.iy0,
        "w": grid.width,
        "h": grid.height,
        "full_per_m": RISK_FULL_PER_M,
        "cells_z": squeeze(risk_code(risk.state, risk.hazard_cvar)),
        "stamp_s": risk.stamp_ns / 1e9,
    }


def tile_part(resolution_m: float, tile: tuple[int, int], cells: NDArray[np.uint8]) -> Part:
    """One tile of the coverage canvas."""
    side = cells.shape[0]
    return {"res": resolution_m, "tx": tile[0], "ty": tile[1], "side": side, "cells_z": squeeze(cells)}


def local_part(irm: LocalIrm) -> Part:
    """The traversable nodes of the Local IRM and their edges (as pairs of places in these columns)."""
    shown = np.flatnonzero(irm.state == 1)
    place = np.full(irm.state.size, -1, np.int64)
    place[shown] = np.arange(shown.size)
    rows, columns = shown // irm.size, shown % irm.size
    pairs, risks = [np.empty((0, 2), np.int64)], [np.empty(0)]
    for direction, (dx, dy) in enumerate(((1, 0), (1, 1), (0, 1), (-1, 1))):
        inside = (columns + dx < irm.size) & (columns + dx >= 0) & (rows + dy < irm.size)
        source = shown[inside & (irm.edge_distance_m[shown, direction] > 0)]
        other = place[source + dy * irm.size + dx]
        pairs.append(np.column_stack((place[source], other))[other >= 0])
        risks.append(irm.edge_risk[source, direction][other >= 0])
    return {
        "spacing": irm.spacing_m,
        "xy": raw(irm.anchor_m[shown], "f4"),
        "risk": raw(irm.node_risk[shown], "f4"),
        "coverage": raw(irm.coverage[shown], "f4"),
        "edges": raw(np.concatenate(pairs), "u2" if shown.size < 2**16 else "u4"),
        "edge_risk": raw(np.rint(np.minimum(np.concatenate(risks), 1.0) * 255), "u1"),
        "version": irm.irm_version,
    }


def graph_parts(graph: RoadMap) -> dict[int, Part]:
    """The Global IRM in chunks by id; an edge is told with its lower end, by the ids of both."""
    chunks: dict[int, Part] = {}
    rows = np.repeat(np.arange(graph.node_id.size), np.diff(graph.indptr))
    upward = np.flatnonzero(graph.indices > rows)
    a, b = graph.node_id[rows[upward]], graph.node_id[graph.indices[upward]]
    risk = np.rint(np.minimum(graph.risk[upward], 1.0) * 255)
    number = graph.node_id // CHUNK_IDS
    for chunk in np.unique(number):
        n0, n1 = np.searchsorted(number, (chunk, chunk + 1))
        e0, e1 = np.searchsorted(a, (chunk * CHUNK_IDS, (chunk + 1) * CHUNK_IDS))
        chunks[int(chunk)] = {
            "id": raw(graph.node_id[n0:n1], "u4"),
            "kind": raw(graph.kind[n0:n1] == FRONTIER, "u1"),
            "xy": raw(graph.xyz_m[n0:n1, :2], "f4"),
            "gain": raw(graph.gain[n0:n1], "f4"),
            "a": raw(a[e0:e1], "u4"),
            "b": raw(b[e0:e1], "u4"),
            "edge_risk": raw(risk[e0:e1], "u1"),
            "driven": raw(graph.driven[upward][e0:e1], "u1"),
        }
    return chunks


def policy_part(policy: GlobalPolicy, graph: RoadMap) -> Part:
    """Target, way and alternatives, and the policy's arrows: (n, 4) from x, y to x, y."""
    ends = {int(node): graph.index_of(int(node)) for node in np.unique(policy.action[policy.action >= 0])}
    arrows = [
        (*policy.node_xyz_m[i, :2], *graph.xyz_m[ends[int(action)], :2])
        for i, action in enumerate(policy.action)
        if action >= 0 and ends[int(action)] >= 0
    ]
    return {
        "target": policy.target,
        "x": policy.target_xyz_m[0],
        "y": policy.target_xyz_m[1],
        "gain": policy.target_gain,
        "distance_m": policy.target_distance_m,
        "risk": policy.target_risk,
        "q": policy.target_q,
        "reason": policy.reason,
        "alternatives": [one.model_dump() for one in policy.alternatives],
        "arrows": raw(np.array(arrows).reshape(-1, 4), "f4"),
        "route": raw(policy.route_xyz_m[:, :2], "f4"),
    }


def path_xy(plan: Plan) -> NDArray[np.float64]:
    """(k, 2) the plan's points in `odom`."""
    return np.column_stack((plan.x_m, plan.y_m))


def plan_part(plan: Plan, old: NDArray[np.float64]) -> Part:
    """The plan, how many of its points were kept, and the policy before it. old: (m, 2) in `odom`."""
    return {
        "id": plan.plan_id,
        "valid": plan.valid,
        "safety": plan.safety.value,
        "reason": plan.reason,
        "tau_s": plan.tau_s,
        "kept": plan.kept_points,
        "xy": raw(path_xy(plan), "f4"),
        "old": raw(old, "f4"),
    }


def fences_part(fences: Fences) -> Part:
    """The polygons: their rings as points in the frame that each names."""
    told = [
        {
            "id": fence.fence_id,
            "kind": fence.kind.value,
            "name": fence.name,
            "frame": fence.frame.value,
            "weight": fence.weight,
            "rings": [ring.points for ring in fence.rings],
        }
        for fence in fences.fences
    ]
    return {"version": fences.version, "fences": told}
