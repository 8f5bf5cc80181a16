"""The simulated SLAM: dead reckoning that drifts, keyframes, and loop closures that move many of them at once.

`odom` is continuous: dead reckoning of the true motion, with drift. `map` is the best estimate: it moves against
`odom` at loop closures alone (REP-105). Height is taken from the true one: an IMU and a LiDAR hold it well.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from planning.frames import Planar
from planning.pose_graph import Edges, between, optimise
from services.sim.config import SlamConfig

_RECENT_M = 10.0
"""Scans hang on keyframes of so much path before now: their place relative to the robot is known by odometry."""
_LEAST_VARIANCE = 1e-6
_LEAST_RATE = 1e-9
"""Less drift (m/m, rad/m) is none."""
_IDENTITY = Planar(0.0, 0.0, 0.0)


class Slam:
    """A pure object: no clock, and every random number from a generator that it is given.

    Drift. Per metre driven, dead reckoning errs by a bias along, one across and one of yaw, each a stationary
    Ornstein-Uhlenbeck process over the distance with the correlation length `drift_correlation_m`. So errors grow
    with the distance at first (`drift_fraction` of it, rms, and `drift_yaw_deg_per_10m`) and, far beyond the
    correlation length, with its root, as those of LiDAR odometry do.

    Loop closures. Where the true robot comes near a keyframe of long ago, a keyframe is added and the measured
    relative pose (true, with noise) joins the graph, which is optimised; `map_to_odom` then jumps so that the robot
    stands at its optimised keyframe. Without drift nothing is closed: `map`, `odom` and the world are one frame.
    """

    def __init__(self, config: SlamConfig, true: Planar, z_m: float, rng: np.random.Generator) -> None:
        self._config = config
        self._rates = np.array(
            [config.drift_fraction / math.sqrt(2.0)] * 2 + [math.radians(config.drift_yaw_deg_per_10m) / 10.0]
        )
        """Standard deviations of the biases: m/m along and across, rad/m."""
        self._drifts = bool((self._rates > _LEAST_RATE).any())
        self._bias = rng.standard_normal(3)
        """In standard deviations."""
        self._true, self._z_m = true, z_m
        self._drift = _IDENTITY
        """Pose of the true world in `odom`: dead reckoning is _drift after the true pose."""
        self.estimate = true
        """Of base_link in `odom`, with white noise."""
        self.map_to_odom = _IDENTITY
        self.revision = 0
        """Number of loop closures."""
        self._path_m, self._closed_at_m = 0.0, -math.inf
        self._odom, self._map, self._was_true = np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3))
        """Keyframes: by odometry, best estimate, truth; x, y, yaw."""
        self._heights_m, self._paths_m, self._spans_m = np.empty(0), np.empty(0), np.empty(0)
        self._closures = np.empty((0, 2), dtype=np.int64)
        self._measured = np.empty((0, 3))

    # --- odometry ---------------------------------------------------------------------------------------------

    def move(self, true: Planar, z_m: float, rng: np.random.Generator) -> None:
        """The true robot has moved there; dead reckoning follows with its drift."""
        driven_m = math.hypot(true.x_m - self._true.x_m, true.y_m - self._true.y_m)
        self._true, self._z_m = true, z_m
        self._path_m += driven_m
        if not self._drifts or driven_m == 0.0:
            return
        stays = math.exp(-driven_m / self._config.drift_correlation_m)
        self._bias = stays * self._bias + math.sqrt(1.0 - stays * stays) * rng.standard_normal(3)
        error = Planar(*(self._rates * self._bias * driven_m).tolist())
        self._drift = self._drift.compose(true).compose(error).compose(true.inverse())

    def look(self, noise: np.random.Generator) -> Planar:
        """The pose of base_link in `odom` now: dead reckoning with white noise. Kept as `estimate`."""
        config, odom = self._config, self.odometry
        x, y, yaw = noise.standard_normal(3).tolist()
        self.estimate = Planar(
            odom.x_m + config.pose_noise_m * x,
            odom.y_m + config.pose_noise_m * y,
            math.remainder(odom.yaw_rad + config.yaw_noise_rad * yaw, 2.0 * math.pi),
        )
        return self.estimate

    @property
    def odometry(self) -> Planar:
        """Dead reckoning without the white noise: continuous."""
        return self._true if self._drift.is_identity else self._drift.compose(self._true)

    @property
    def pose_in_map(self) -> Planar:
        """The estimate in `map`."""
        return self.estimate if self.map_to_odom.is_identity else self.map_to_odom.compose(self.estimate)

    # --- keyframes and closures -------------------------------------------------------------------------------

    @property
    def keyframes(self) -> NDArray[np.float64]:
        """Poses in `map`, (n, 4): x, y, z, yaw."""
        return np.column_stack([self._map[:, :2], self._heights_m, self._map[:, 2]])

    def update(self, rng: np.random.Generator) -> bool:
        """Add a keyframe and close a loop where they are due. Whether the graph has changed. rng: of the closure."""
        old = self._to_close()
        if old is None and not self._is_far_from_last():
            return False
        self._add_keyframe()
        if old is not None:
            self._close(old, rng)
        return True

    def _is_far_from_last(self) -> bool:
        if not len(self._odom):
            return True
        x, y, _ = self._odom[-1].tolist()
        away_m = math.hypot(self.estimate.x_m - x, self.estimate.y_m - y)
        return away_m >= self._config.keyframe_spacing_m

    def _add_keyframe(self) -> None:
        span_m = self._span_m()
        self._odom = np.vstack([self._odom, self.estimate])
        self._map = np.vstack([self._map, self.pose_in_map])
        self._was_true = np.vstack([self._was_true, self._true])
        self._heights_m = np.append(self._heights_m, self._z_m)
        self._paths_m = np.append(self._paths_m, self._path_m)
        self._spans_m = np.append(self._spans_m, span_m)

    def _to_close(self) -> int | None:
        """The oldest keyframe that a loop can be closed to now, if any."""
        config = self._config
        if not self._drifts or self._path_m - self._closed_at_m < config.closure_interval_m:
            return None
        old = self._was_true[: np.searchsorted(self._paths_m, self._path_m - config.closure_min_path_m)]
        away_m = np.hypot(old[:, 0] - self._true.x_m, old[:, 1] - self._true.y_m)
        near = np.flatnonzero(away_m < config.closure_radius_m)
        return int(near[0]) if len(near) else None

    def _close(self, old: int, rng: np.random.Generator) -> None:
        """Measure the newest keyframe from an old one, optimise, and move `odom` in `map` accordingly."""
        config = self._config
        deviation = np.array([config.closure_noise_m, config.closure_noise_m, config.closure_yaw_noise_rad])
        measured = between(self._was_true[old], self._was_true[-1]) + deviation * rng.standard_normal(3)
        self._closures = np.vstack([self._closures, [old, len(self._map) - 1]])
        self._measured = np.vstack([self._measured, measured])
        self._map = optimise(self._map, self._edges(deviation))
        newest = Planar(*self._map[-1].tolist())
        self.map_to_odom = newest.compose(self.estimate.inverse())
        self._spans_m = self._shortest_spans()
        self._closed_at_m = self._path_m
        self.revision += 1

    def _edges(self, closure_deviation: NDArray[np.float64]) -> Edges:
        """The chain by odometry and the closures, with their information."""
        n, config = len(self._odom), self._config
        white = 2.0 * np.array([config.pose_noise_m, config.pose_noise_m, config.yaw_noise_rad]) ** 2
        # The chain's errors are alike over a long way. As independent ones they must be as large as the long run
        # makes them, or the chain would seem surer than it is and resist its closures.
        per_m = 2.0 * config.drift_correlation_m * self._rates**2
        chain = white + per_m * np.diff(self._paths_m)[:, None]
        closed = np.broadcast_to(closure_deviation**2, self._measured.shape)
        variance = np.maximum(np.concatenate([chain, closed]), _LEAST_VARIANCE)
        information = np.zeros((len(variance), 3, 3))
        information[:, [0, 1, 2], [0, 1, 2]] = 1.0 / variance
        index = np.arange(n - 1)
        return Edges(
            np.concatenate([index, self._closures[:, 0]]),
            np.concatenate([index + 1, self._closures[:, 1]]),
            np.concatenate([between(self._odom[:-1], self._odom[1:]), self._measured]),
            information,
        )

    def nearest(self) -> tuple[int, Planar]:
        """Nearest keyframe in `map` (with drift: among recent ones), and the estimate in its frame."""
        first = 0
        if self._drifts:
            recent = int(np.searchsorted(self._paths_m, self._path_m - _RECENT_M))
            first = min(recent, len(self._paths_m) - 1)
        here = self.pose_in_map
        offsets = self._map[first:, :2] - here[:2]
        index = first + int(np.argmin(np.square(offsets).sum(axis=1)))
        return index, Planar(*self._map[index].tolist()).inverse().compose(here)

    # --- uncertainty ------------------------------------------------------------------------------------------

    def variances(self) -> NDArray[np.float64]:
        """Of the estimate's x, y and yaw in `map`, shape (3,). See `keyframe_variances`."""
        here = np.array(self.pose_in_map[:2])
        passed = self._map[:, :2] if len(self._map) else here[None]
        lever_m2 = np.square(here - passed).sum(axis=1).mean()
        return self._grown(np.array([self._span_m()]), np.array([lever_m2]))[0]

    def keyframe_variances(self) -> NDArray[np.float64]:
        """Of x, y and yaw of every keyframe in `map`, (n, 3), relative to the first one.

        An approximation of the marginal variances: the error of dead reckoning along the shortest way through the
        graph to the first keyframe, where a closure counts as the distance over which dead reckoning errs as much.
        An error of yaw moves a keyframe by its distance from the path before it (rms). Other ways through the graph
        only add information: the optimised graph is as good or better.
        """
        xy = self._map[:, :2]
        count = np.arange(1, len(xy) + 1)
        mean = np.cumsum(xy, axis=0) / count[:, None]
        mean_square = np.cumsum(np.square(xy).sum(axis=1)) / count
        lever_m2 = np.square(xy).sum(axis=1) - 2.0 * (xy * mean).sum(axis=1) + mean_square
        return self._grown(self._spans_m, np.maximum(lever_m2, 0.0))

    def _grown(self, spans_m: NDArray[np.float64], lever_m2: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variances (n, 3) after so much dead reckoning: white noise, and the drift's integral over the distance."""
        config = self._config
        deviation = np.array([config.pose_noise_m, config.pose_noise_m, config.yaw_noise_rad])
        white = np.maximum(deviation**2, _LEAST_VARIANCE)
        if not self._drifts:
            return np.tile(white, (len(spans_m), 1))
        length = config.drift_correlation_m
        integral_m2 = 2.0 * length**2 * (spans_m / length + np.expm1(-spans_m / length))
        drift = integral_m2[:, None] * self._rates**2
        # Half of it in x and half in y: which of them depends on the way.
        drift[:, :2] += 0.5 * (lever_m2 * drift[:, 2])[:, None]
        return white + drift

    def _span_m(self) -> float:
        """Dead reckoning between here and the first keyframe, by the shortest way through the graph."""
        if not len(self._spans_m):
            return 0.0
        return float(self._spans_m[-1] + self._path_m - self._paths_m[-1])

    def _shortest_spans(self) -> NDArray[np.float64]:
        n, config = len(self._map), self._config
        noise = (config.closure_noise_m, config.closure_noise_m, config.closure_yaw_noise_rad)
        as_path_m = max(s / r for s, r in zip(noise, self._rates.tolist(), strict=True) if r > _LEAST_RATE)
        index = np.arange(n - 1)
        rows = np.concatenate([index, self._closures[:, 0]])
        columns = np.concatenate([index + 1, self._closures[:, 1]])
        # Dijkstra takes a zero for no edge.
        chain_m = np.maximum(np.diff(self._paths_m), 1e-9)
        lengths = np.concatenate([chain_m, np.full(len(self._closures), max(as_path_m, 1e-9))])
        graph = csr_array((lengths, (rows, columns)), shape=(n, n))
        return dijkstra(graph, directed=False, indices=np.array([0]))[0]

    # --- snapshots --------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "bias": self._bias,
            "poses": [list(p) for p in (self._true, self._drift, self.estimate, self.map_to_odom)],
            "numbers": [self._z_m, self.revision, self._path_m, self._closed_at_m],
            "keyframes": [self._odom, self._map, self._was_true],
            "along": [self._heights_m, self._paths_m, self._spans_m],
            "closures": [self._closures, self._measured],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self._bias = state["bias"]
        self._true, self._drift, self.estimate, self.map_to_odom = (Planar(*p) for p in state["poses"])
        self._z_m, self.revision, self._path_m, self._closed_at_m = state["numbers"]
        self._odom, self._map, self._was_true = state["keyframes"]
        self._heights_m, self._paths_m, self._spans_m = state["along"]
        self._closures, self._measured = state["closures"]
