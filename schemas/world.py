"""The belief about the world: risk, coverage, and the two Information RoadMaps (paper, Algorithm 1)."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from schemas.base import Array, Header, Message, Pose, column


class GridHeader(Header):
    """Where a grid lies: cell (row, column) has global index (ix0 + column, iy0 + row), row 0 the lowest y."""

    resolution_m: float = Field(gt=0.005, le=10)
    ix0: int = Field(ge=-(2**31), le=2**31)
    iy0: int = Field(ge=-(2**31), le=2**31)
    width: int = Field(gt=0, le=4096)
    height: int = Field(gt=0, le=4096)


class RiskMap(Message):
    """Belief about traversal risk W_r around the robot, in `odom`. stamp: that of the newest cloud in it.

    state: 0 unknown, 1 free, 2 lethal. hazard_*: hazard rate per metre travelled (mean, variance, CVaR), 1/m.
    clearance_m: distance from the cell's centre to the nearest lethal surface. elevation_m: ground height. top_m:
    height of the ground or of what stands on it, over which a sensor has to look; (0, 0) when the risk map knows no
    heights, and every cell that is not free blocks the sight. All (h, w), row 0 the lowest y.
    """

    schema_name: ClassVar[str] = "risk_map"
    schema_version: ClassVar[int] = 2

    grid: GridHeader
    robot_pose: Pose
    footprint_radius_m: float = Field(gt=0, le=5)
    state: Annotated[Array, column("uint8", "h", "w", maximum=2)]
    hazard_mean: Annotated[Array, column("float32", "h", "w", minimum=0)]
    hazard_variance: Annotated[Array, column("float32", "h", "w", minimum=0)]
    hazard_cvar: Annotated[Array, column("float32", "h", "w", minimum=0)]
    clearance_m: Annotated[Array, column("float32", "h", "w", minimum=0)]
    elevation_m: Annotated[Array, column("float32", "h", "w")]
    top_m: Annotated[Array, column("float32", "top_h", "top_w")]

    @model_validator(mode="after")
    def _check_top(self) -> RiskMap:
        if self.top_m.shape not in ((0, 0), self.state.shape):
            raise ValueError(f"top_m: shape {self.top_m.shape}, neither (0, 0) nor {self.state.shape} as state")
        return self


class MovingPoints(Message):
    """What moves in the newest cloud: points_m (n, 2) in `odom`, on the surface of what has come into free ground."""

    schema_name: ClassVar[str] = "moving_points"

    points_m: Annotated[Array, column("float32", "n", 2)]


class LocalIrm(Message):
    """The Local IRM: a rolling lattice of nodes snapped to multiples of the spacing, in `odom`.

    Node i = row * size + column has lattice index (ix0 + column, iy0 + row); its patch is that square. Its anchor is
    the traversable point that stands for it. state: 0 unknown, 1 traversable, 2 not traversable.
    node_risk: mean hazard rate in the patch, 1/m. coverage: mean coverage probability of the patch's reachable
    ground. entropy: summed entropy of that ground, in nats of a whole patch: log 2 times the share of the patch that is
    ground and unseen. edge_*: (n, 8), the edge towards direction k (E, counter-clockwise); distance 0: no edge.
    edge_risk: probability rho of failing on the edge, swept. bent_*: edges that are not straight: bent_edge = node * 8
    + k for k < 4 (the other way is the reverse), its inner points bent_xy[bent_start[b]:bent_start[b + 1]].
    visible: (n, 2 * reach + 1) rows of bits: bit c of row r set when the node at offset (c - reach, r - reach) has
    its uncovered ground in line of sight from this node's anchor within the coverage sensor's range.
    """

    schema_name: ClassVar[str] = "local_irm"

    irm_version: int = Field(ge=1)
    risk_stamp_ns: int = Field(ge=0)
    spacing_m: float = Field(gt=0, le=10)
    ix0: int
    iy0: int
    size: int = Field(gt=0, le=61, description="Nodes a side; a row of coverage bits fits one 64-bit word.")
    robot_pose: Pose
    map_to_odom: Pose
    sensor_range_m: float = Field(gt=0)
    sensor_fov_rad: float = Field(gt=0)
    reach: int = Field(ge=0, le=15)
    state: Annotated[Array, column("uint8", "n", maximum=2)]
    anchor_m: Annotated[Array, column("float64", "n", 2)]
    node_risk: Annotated[Array, column("float32", "n", minimum=0)]
    coverage: Annotated[Array, column("float32", "n", minimum=0, maximum=1)]
    entropy: Annotated[Array, column("float32", "n", minimum=0)]
    edge_distance_m: Annotated[Array, column("float32", "n", 8, minimum=0)]
    edge_risk: Annotated[Array, column("float32", "n", 8, minimum=0, maximum=1)]
    bent_edge: Annotated[Array, column("int32", "b", minimum=0)]
    bent_start: Annotated[Array, column("int32", "b1", minimum=0)]
    bent_xy: Annotated[Array, column("float32", "p", 2)]
    visible: Annotated[Array, column("uint32", "n", "rows")]


BREADCRUMB = 0
FRONTIER = 1

MAX_NODE_ID = 20_000_000
"""Ids are given one after the other; readers keep tables by id. Hundreds of days of frontiers."""


class GlobalIrm(Message):
    """The Global IRM in `map`, whole (base_version 0) or as the difference to base_version.

    node_*: nodes that are new or changed. kind: 0 breadcrumb, 1 frontier. gain: expected information gain, nats of
    whole patches. edge_a < edge_b: node ids. driven: the robot itself went along the edge.
    removed_node, removed_edge: what is gone. robot_node: breadcrumb nearest to the robot by travel.
    """

    schema_name: ClassVar[str] = "global_irm"

    irm_version: int = Field(ge=1)
    base_version: int = Field(ge=0)
    robot_pose: Pose
    map_to_odom: Pose
    robot_node: int = Field(ge=0)
    node_id: Annotated[Array, column("int64", "n", minimum=0, maximum=MAX_NODE_ID)]
    node_kind: Annotated[Array, column("uint8", "n", maximum=1)]
    node_xyz_m: Annotated[Array, column("float64", "n", 3)]
    node_gain: Annotated[Array, column("float64", "n", minimum=0)]
    node_coverage: Annotated[Array, column("float32", "n", minimum=0, maximum=1)]
    edge_a: Annotated[Array, column("int64", "e", minimum=0, maximum=MAX_NODE_ID)]
    edge_b: Annotated[Array, column("int64", "e", minimum=0, maximum=MAX_NODE_ID)]
    edge_distance_m: Annotated[Array, column("float64", "e", minimum=0)]
    edge_risk: Annotated[Array, column("float64", "e", minimum=0, maximum=1)]
    edge_driven: Annotated[Array, column("uint8", "e", maximum=1)]
    removed_node: Annotated[Array, column("int64", "rn", minimum=0)]
    removed_edge: Annotated[Array, column("int64", "re", 2, minimum=0)]


class GraphRequest(Message):
    """A reader of the Global IRM has missed a difference and asks for the whole graph."""

    schema_name: ClassVar[str] = "graph_request"

    have_version: int = Field(ge=0)


class CoverageSummary(Message):
    """How far the coverage is, by the belief; what is left, and what was given up and why.

    covered_fraction: of the ground known to be reachable. unreachable_*: frontiers on the expiring list.
    """

    schema_name: ClassVar[str] = "coverage_summary"

    irm_version: int = Field(ge=1)
    reachable_area_m2: float = Field(ge=0)
    covered_area_m2: float = Field(ge=0)
    covered_fraction: float = Field(ge=0, le=1)
    entropy_left: float = Field(
        ge=0, description="Summed entropy of reachable ground, nats of whole patches."
    )
    frontiers: int = Field(ge=0)
    frontier_gain: float = Field(ge=0)
    breadcrumbs: int = Field(ge=0)
    settled: bool = Field(description="No frontier, and nothing in sight that could become one.")
    unreachable_xy_m: Annotated[Array, column("float64", "u", 2)]
    unreachable_gain: Annotated[Array, column("float64", "u", minimum=0)]
    unreachable_reason: list[str]


class CoverageWindow(Message):
    """The belief around the robot as a picture, in `map`.

    cell: (height, width): 0 unknown, 1 reachable ground not covered, 2 covered ground, 3 obstacle,
    4 free but out of the robot's reach.
    """

    schema_name: ClassVar[str] = "coverage_window"

    grid: GridHeader
    cell: Annotated[Array, column("uint8", "h", "w", maximum=4)]
