"""g2o files: VERTEX_SE2 with EDGE_SE2, or VERTEX_SE3:QUAT with EDGE_SE3:QUAT, metres and radians.

The format is that of g2o (Kuemmerle et al., ICRA 2011): the information matrix of an edge stands as its upper
triangle, row by row; that of an SE3 edge is of the place and of the vector part of the quaternion, which is half of
the rotation vector. Files often hold dead reckoning as vertices: the graph is optimised when it is read.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from planning.pose_graph import Edges, cost, optimise
from planning.pose_graph_3d import Edges3d, Poses3d, cost_3d, optimise_3d
from plgrim.feeds.errors import FeedError

_IGNORED = frozenset({"FIX", "PARAMS_SE2OFFSET", "PARAMS_SE3OFFSET"})
Rows = list[tuple[int, list[float]]]
"""(line number, numbers) of the records of one kind."""


class _Kind(NamedTuple):
    """How long the records are: numbers of a pose and unknowns of it."""

    vertex: str
    edge: str
    pose: int
    unknowns: int


_PLANAR = _Kind("VERTEX_SE2", "EDGE_SE2", 3, 3)
_SPATIAL = _Kind("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", 7, 6)


class PoseGraphFile(NamedTuple):
    """A pose graph, optimised. ids: (n,) ascending, taken as the order of driving. pose: (n, 4) x, y, z, yaw.

    edges, closures: number of edges, and of those that are not between successive vertices. cost: half the weighted
    sum of squares of the file's own vertices and of the optimum.
    """

    ids: NDArray[np.int64]
    pose: NDArray[np.float64]
    spatial: bool
    edges: int
    closures: int
    cost: tuple[float, float]


def read_g2o(path: Path) -> PoseGraphFile:
    """Read and optimise a pose graph. Raises FeedError with file, line and mend."""
    kind, vertices, edges = _records(path)
    ids, poses = _vertices(path, kind, vertices)
    first, second, measured, information = _edges(path, kind, edges, ids)
    _check_connected(path, ids, first, second)
    if kind is _PLANAR:
        flat = Edges(first, second, measured, information)
        best = optimise(poses, flat)
        costs = cost(poses, flat), cost(best, flat)
        pose = np.column_stack([best[:, :2], np.zeros(len(best)), best[:, 2]])
    else:
        pose, costs = _optimised_3d(poses, first, second, measured, information)
    closures = int((np.abs(second - first) != 1).sum())
    return PoseGraphFile(ids, pose, kind is _SPATIAL, len(first), closures, costs)


def _records(path: Path) -> tuple[_Kind, Rows, Rows]:
    """The records of the file's kind, checked for length and finite numbers."""
    found: dict[str, Rows] = {}
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except OSError as error:
        raise FeedError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise FeedError(f"{path}: not a g2o file: g2o is plain text") from error
    for number, line in enumerate(lines, start=1):
        tag, *words = line.split("#")[0].split() or [""]
        if not tag or tag in _IGNORED:
            continue
        kind = next((k for k in (_PLANAR, _SPATIAL) if tag in (k.vertex, k.edge)), None)
        if kind is None:
            raise FeedError(
                f"{path}:{number}: record {tag!r} is not supported: "
                f"{_PLANAR.vertex}, {_PLANAR.edge}, {_SPATIAL.vertex} and {_SPATIAL.edge} are"
            )
        found.setdefault(tag, []).append((number, _numbers(path, number, tag, kind, words)))
    kinds = [k for k in (_PLANAR, _SPATIAL) if k.vertex in found or k.edge in found]
    if len(kinds) != 1:
        mixed = "mixes SE2 and SE3 records" if kinds else "holds no vertices and edges"
        raise FeedError(f"{path}: {mixed}; a pose graph has one kind of both")
    kind = kinds[0]
    if kind.vertex not in found:
        raise FeedError(f"{path}: holds edges but no {kind.vertex}: write the vertices (initial poses) too")
    return kind, found[kind.vertex], found.get(kind.edge, [])


def _numbers(path: Path, number: int, tag: str, kind: _Kind, words: list[str]) -> list[float]:
    triangle = kind.unknowns * (kind.unknowns + 1) // 2
    wanted = 1 + kind.pose if tag == kind.vertex else 2 + kind.pose + triangle
    if len(words) != wanted:
        raise FeedError(f"{path}:{number}: {tag} has {len(words)} values, {wanted} are wanted")
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise FeedError(f"{path}:{number}: {tag}: {error}") from error
    if not all(math.isfinite(value) for value in values):
        raise FeedError(f"{path}:{number}: {tag} holds a number that is not finite")
    ids = values[: 1 if tag == kind.vertex else 2]
    if any(i != int(i) or not 0 <= i < 2**53 for i in ids):
        raise FeedError(f"{path}:{number}: {tag}: an id is a whole number from 0")
    return values


def _vertices(path: Path, kind: _Kind, rows: Rows) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Ids ascending, and the poses (n, 3) or (n, 7)."""
    by_id: dict[int, tuple[int, list[float]]] = {}
    for number, values in rows:
        before = by_id.get(int(values[0]))
        if before is not None:
            raise FeedError(f"{path}:{number}: vertex {int(values[0])} stands in line {before[0]} too")
        if kind is _SPATIAL:
            _check_quaternion(path, number, values[4:8])
        by_id[int(values[0])] = number, values[1:]
    ids = np.array(sorted(by_id), dtype=np.int64)
    return ids, np.array([by_id[int(i)][1] for i in ids], dtype=np.float64)


def _edges(
    path: Path, kind: _Kind, rows: Rows, ids: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """(first, second) as indices, measured poses and information matrices."""
    index = {int(i): k for k, i in enumerate(ids)}
    d = kind.unknowns
    information = np.zeros((len(rows), d, d))
    upper = np.triu_indices(d)
    ends = np.zeros((2, len(rows)), dtype=np.int64)
    measured = np.zeros((len(rows), kind.pose))
    for k, (number, values) in enumerate(rows):
        for end in (0, 1):
            if int(values[end]) not in index:
                raise FeedError(
                    f"{path}:{number}: {kind.edge} names vertex {int(values[end])}, which is missing"
                )
            ends[end, k] = index[int(values[end])]
        if ends[0, k] == ends[1, k]:
            raise FeedError(f"{path}:{number}: {kind.edge} leads from a vertex to itself")
        measured[k] = values[2 : 2 + kind.pose]
        if kind is _SPATIAL:
            _check_quaternion(path, number, values[5:9])
        information[k][upper] = values[2 + kind.pose :]
        information[k] += np.triu(information[k], 1).T
        if np.linalg.eigvalsh(information[k])[0] <= 0.0:
            raise FeedError(f"{path}:{number}: {kind.edge}: the information matrix is not positive definite")
    return ends[0], ends[1], measured, information


def _check_quaternion(path: Path, number: int, quaternion: list[float]) -> None:
    if abs(math.hypot(*quaternion) - 1.0) > 0.01:
        raise FeedError(
            f"{path}:{number}: a quaternion (x, y, z, w) of length {math.hypot(*quaternion):.3g}, not 1"
        )


def _check_connected(
    path: Path, ids: NDArray[np.int64], first: NDArray[np.int64], second: NDArray[np.int64]
) -> None:
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(ids), len(ids)))
    parts, of = connected_components(graph, directed=False)
    if parts > 1:
        other = int(ids[np.flatnonzero(of != of[0])[0]])
        raise FeedError(
            f"{path}: the graph has {parts} parts: no edges lead from vertex {ids[0]} to vertex {other}"
        )


def _optimised_3d(
    poses: NDArray[np.float64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    measured: NDArray[np.float64],
    information: NDArray[np.float64],
) -> tuple[NDArray[np.float64], tuple[float, float]]:
    halved = information.copy()  # from quaternions to rotation vectors
    halved[:, 3:, :] /= 2.0
    halved[:, :, 3:] /= 2.0
    edges = Edges3d(first, second, measured[:, :3], Rotation.from_quat(measured[:, 3:]).as_matrix(), halved)
    start = Poses3d(poses[:, :3], Rotation.from_quat(poses[:, 3:]).as_matrix())
    best = optimise_3d(start, edges)
    yaw = np.arctan2(best.turn[:, 1, 0], best.turn[:, 0, 0])
    return np.column_stack([best.place, yaw]), (cost_3d(start, edges), cost_3d(best, edges))
