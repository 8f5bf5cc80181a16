"""From a Local IRM, a junction belief and the global policy to the model that POMCP searches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.coverage_build import RootBelief, build_model, reachable_entropy
from planning.coverage_model import CoverageModel
from planning.frames import planar
from planning.lattice_graph import spread_values
from planning.reward import RewardWeights, parameters
from schemas.policy import EpisodeRequest, GlobalPolicy
from schemas.world import LocalIrm
from services.lcp.config import Config


@dataclass(frozen=True, slots=True)
class Junction:
    """Where the new policy begins: the most likely node and heading, and the belief about both."""

    node: int
    heading: int
    particle_node: NDArray[np.int32]
    particle_heading: NDArray[np.uint8]
    particle_weight: NDArray[np.float64]
    covered: NDArray[np.uint64]


def junction_of(request: EpisodeRequest, irm: LocalIrm) -> Junction:
    """The junction belief of a request; ValueError when it does not fit the Local IRM."""
    n = irm.size * irm.size
    total = float(request.particle_weight.sum())
    if len(request.particle_node) == 0 or total <= 0.0:
        raise ValueError("the junction belief is empty")
    if int(request.particle_node.max()) >= n or len(request.covered) != irm.size:
        raise ValueError("the junction belief does not fit the Local IRM")
    weight = request.particle_weight / total
    best = int(np.argmax(weight))
    return Junction(
        int(request.particle_node[best]),
        int(request.particle_heading[best]),
        request.particle_node,
        request.particle_heading,
        weight,
        request.covered,
    )


def local_entropy(irm: LocalIrm) -> NDArray[np.float64]:
    """Entropy of each node that can be covered from some connected node; 0 for the others. (n,)"""
    return reachable_entropy(irm.entropy, irm.visible, irm.edge_distance_m, irm.size, irm.reach)


def leaf_values(irm: LocalIrm, policy: GlobalPolicy | None, weights: RewardWeights) -> NDArray[np.float64]:
    """What the rest of the mission is worth from each node: the global values spread over the lattice. (n,)"""
    n = irm.size * irm.size
    value = np.zeros(n)
    if policy is None or len(policy.value_to_go) == 0 or float(policy.value_to_go.max()) <= 0.0:
        return value
    seed = np.full(n, -np.inf)
    to_odom = planar(policy.map_to_odom).inverse()
    for xyz, v in zip(policy.node_xyz_m, policy.value_to_go, strict=True):
        x, y = to_odom.apply(float(xyz[0]), float(xyz[1]))
        node = node_at(irm, x, y)
        if node >= 0 and irm.state[node] == 1 and v > 0.0:
            seed[node] = max(seed[node], float(v))
    p = parameters(weights)
    spread_values(
        seed, irm.size, irm.edge_distance_m, irm.edge_risk, p.gamma_per_m, p.k_cost * p.k_distance_per_m,
        p.k_cost * p.k_risk, value,
    )  # fmt: skip
    return value


def node_at(irm: LocalIrm, x_m: float, y_m: float) -> int:
    """The node whose patch holds a point in odom, or -1 outside."""
    column = math.floor(x_m / irm.spacing_m) - irm.ix0
    row = math.floor(y_m / irm.spacing_m) - irm.iy0
    if not (0 <= row < irm.size and 0 <= column < irm.size):
        return -1
    return row * irm.size + column


def coverage_model(
    irm: LocalIrm,
    entropy: NDArray[np.float64],
    leaf: NDArray[np.float64],
    junction: Junction,
    config: Config,
) -> CoverageModel:
    """The generative model of this episode."""
    return build_model(
        size=irm.size,
        reach=irm.reach,
        fov_rad=irm.sensor_fov_rad,
        edge_distance_m=irm.edge_distance_m,
        edge_risk=irm.edge_risk,
        entropy=entropy,
        visible=irm.visible,
        leaf_value=leaf,
        root=RootBelief(
            junction.particle_node, junction.particle_heading, junction.particle_weight, junction.covered
        ),
        weights=parameters(config.weights),
        horizon=config.horizon,
        rollout_random=config.rollout_random,
        macros=config.macros,
    )
