"""How fast the terrain model is: `python -m tests.bench.riskmap`.

Prints the milliseconds of one thread for integrating a cloud of 100,000 points on rough ground and for making the risk
layers, and how much of one core both take at 10 clouds and 5 risk maps a second. The robot drives, so the window rolls.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.sensing import PointCloud
from services.riskmap.config import Config
from services.riskmap.terrain_model import TerrainModel
from tests.riskmap.rough import MOUNT, RANGE_M, scan, sensor_pose, stand_on

_RINGS = 64
_SPEED_MPS = 1.0
_CLOUD_HZ, _MAP_HZ = 10.0, 5.0


def rough_ground(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """A cave's floor between walls: waves of many lengths, and stumps."""
    z = 0.12 * np.sin(0.7 * x + 0.4 * y) + 0.06 * np.sin(2.1 * y - 0.9 * x) + 0.02 * np.sin(6.0 * x + 5.0 * y)
    stumps = np.where((np.sin(1.3 * x) > 0.97) & (np.cos(1.7 * y) > 0.97), 0.5, 0.0)
    walls = np.where(np.abs(y - 1.5 * np.sin(0.2 * x)) > 5.0, 3.0, 0.0)
    result: NDArray[np.float64] = z + stumps + walls
    return result


def clouds(count: int, points: int) -> list[tuple[Pose, PointCloud]]:
    """A drive of `count` sweeps with exactly `points` points each (what is missing is repeated)."""
    rng = np.random.default_rng(0)
    found = []
    for k in range(count):
        base = stand_on(rough_ground, k * _SPEED_MPS / _CLOUD_HZ, 0.0)
        rings = np.linspace(-25.0, 15.0, _RINGS).tolist()
        sweep = scan(rough_ground, base, round(1.1 * points / _RINGS), rings, 0.01, rng)
        cloud = PointCloud(
            stamp_ns=k + 1, sensor_in_odom=sensor_pose(base), sensor_in_base=MOUNT, range_m=RANGE_M,
            points_m=np.resize(sweep, (points, 3)),
        )  # fmt: skip
        found.append((base, cloud))
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--clouds", type=int, default=20, help="different sweeps; driven to and fro")
    parser.add_argument("--rounds", type=int, default=100, help="sweeps integrated")
    parser.add_argument("--profile", default="husky")
    options = parser.parse_args()
    model = TerrainModel(Config(model="terrain", profile=options.profile))
    drive = clouds(options.clouds, options.points)
    order = [*range(len(drive)), *range(len(drive) - 2, 0, -1)]
    integrate, layers = [], []
    for k in range(options.rounds + 2):
        base, cloud = drive[order[k % len(order)]]
        start = time.thread_time_ns()
        model.roll_to(base.x_m, base.y_m)
        model.integrate(cloud)
        middle = time.thread_time_ns()
        model.layers(base)
        integrate.append((middle - start) / 1e6)
        layers.append((time.thread_time_ns() - middle) / 1e6)
    _print(options.points, np.array(integrate[2:]), np.array(layers[2:]))


def _print(points: int, integrate_ms: NDArray[np.float64], layers_ms: NDArray[np.float64]) -> None:
    for name, each in (("integrate a cloud", integrate_ms), ("risk layers", layers_ms)):
        print(f"{name:18s} p50 {np.percentile(each, 50):6.1f} ms   p99 {np.percentile(each, 99):6.1f} ms")
    load = float(np.mean(integrate_ms) * _CLOUD_HZ + np.mean(layers_ms) * _MAP_HZ) / 1000.0
    print(
        f"{points} points a cloud at {_CLOUD_HZ:.0f} Hz and {_MAP_HZ:.0f} risk maps a second: "
        f"{100.0 * load:.0f} % of one core, {1.0 / load:.1f} times real time"
    )


if __name__ == "__main__":
    main()
