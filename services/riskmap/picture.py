"""A picture of the risk map of one LiDAR scan: `python -m services.riskmap.picture scan.ply picture.png`."""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from planning.grid import GridSpec
from schemas.base import Pose
from schemas.sensing import PointCloud
from services.riskmap.collision import RiskLayers
from services.riskmap.config import Config
from services.riskmap.terrain_model import TerrainModel

_NUMPY_TYPES = {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "uchar": "u1", "uint8": "u1"}
_STATES = ListedColormap(["#3b3b46", "#8fd694", "#d1495b"])
"""Unknown, free, lethal."""


def read_ply_points(path: Path) -> NDArray[np.float32]:
    """Points (n, 3) of a binary little-endian PLY file whose first element is its vertices.

    Raises ValueError when the file is something else.
    """
    raw = path.read_bytes()
    head, _, body = raw.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").splitlines()
    if not lines or lines[0] != "ply" or "format binary_little_endian 1.0" not in lines:
        raise ValueError(f"{path}: not a binary little-endian PLY file")
    count, fields, inside = 0, [], False
    for words in (line.split() for line in lines):
        if words[0] == "element":
            inside = words[1] == "vertex"
            count = int(words[2]) if inside else count
        elif words[0] == "property" and inside:
            if words[1] not in _NUMPY_TYPES:
                raise ValueError(f"{path}: vertices of type {words[1]} are not supported")
            fields.append((words[-1], "<" + _NUMPY_TYPES[words[1]]))
    table = np.frombuffer(body, dtype=np.dtype(fields), count=count)
    return np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float32)


def sensor_over_ground(points_m: NDArray[np.float32], within_m: float = 8.0) -> Pose:
    """How the sensor of a scan stands over the ground around it: its height, roll and pitch.

    The plane of least squares through the lowest points of a polar grid (10 degrees by 1 m), fitted again without those
    that lie more than 0.2 m off. points_m: (n, 3) in the sensor's frame, z up. Raises ValueError when little is near.
    """
    points = points_m[np.isfinite(points_m).all(axis=1)].astype(np.float64)
    distance = np.hypot(points[:, 0], points[:, 1])
    near = (distance > 1.0) & (distance < within_m) & (points[:, 2] < 0.0)
    points, distance = points[near], distance[near]
    sector = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) * 18 / np.pi).astype(np.int64)
    bins = sector * 64 + distance.astype(np.int64)
    order = np.lexsort((points[:, 2], bins))
    lowest = points[order[np.unique(bins[order], return_index=True)[1]]]
    if len(lowest) < 10:
        raise ValueError(f"too few points within {within_m} m below the sensor")
    keep = np.ones(len(lowest), dtype=np.bool_)
    for _ in range(10):
        a = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
        plane = np.linalg.lstsq(a[keep], lowest[keep, 2], rcond=None)[0]
        residual = lowest[:, 2] - a @ plane
        keep = np.abs(residual - np.median(residual)) < max(0.2, float(np.percentile(np.abs(residual), 25)))
    up = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(plane[0] ** 2 + plane[1] ** 2 + 1.0)
    roll, pitch = np.arctan2(up[1], up[2]), -np.arcsin(up[0])
    return Pose(z_m=float(-plane[2] * up[2]), roll_rad=float(roll), pitch_rad=float(pitch))


def scan_layers(
    points_m: NDArray[np.float32], config: Config
) -> tuple[GridSpec, RiskLayers, NDArray[np.float32]]:
    """The risk map of one scan, on a robot that stands below the sensor, and the ground's height over its feet."""
    mount = sensor_over_ground(points_m)
    cloud = PointCloud(
        stamp_ns=1, sensor_in_odom=mount, sensor_in_base=mount, range_m=100.0, points_m=points_m
    )
    model = TerrainModel(config)
    model.roll_to(0.0, 0.0)
    model.integrate(cloud)
    return (model.spec, *model.layers(Pose()))


def draw_scan(points_m: NDArray[np.float32], config: Config) -> Figure:
    """State, CVaR of the hazard rate and height of the ground around the sensor, with the points from above."""
    spec, layers, height_m = scan_layers(points_m, config)
    extent = (
        spec.ix0 * spec.resolution_m, (spec.ix0 + spec.width) * spec.resolution_m,
        spec.iy0 * spec.resolution_m, (spec.iy0 + spec.height) * spec.resolution_m,
    )  # fmt: skip
    figure = Figure(figsize=(16, 16), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    inside = (np.abs(points_m[:, 0]) < extent[1]) & (np.abs(points_m[:, 1]) < extent[3])
    seen = points_m[inside]
    dots = axes[0, 0].scatter(
        seen[:, 0], seen[:, 1], c=np.clip(seen[:, 2], -2.5, 2.0), s=0.6, cmap="viridis", linewidths=0
    )
    known = np.where(layers.state > 0, height_m, np.nan)
    pictures = (
        ("state: unknown, free, lethal", layers.state, _STATES, 0.0, 2.0),
        (f"hazard rate, CVaR at {config.alpha}, 1/m", layers.hazard_cvar, mpl.colormaps["magma"], 0.0, 2.0),
        ("ground over the robot's feet, m", known, mpl.colormaps["terrain"], -1.5, 1.5),
    )
    axes[0, 0].set_title("points from above; colour: height over the sensor, m")
    figure.colorbar(dots, ax=axes[0, 0], shrink=0.7)
    for axis, (title, layer, colours, low, high) in zip(axes.flat[1:], pictures, strict=True):
        shown = axis.imshow(layer, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high)
        axis.set_title(title)
        figure.colorbar(shown, ax=axis, shrink=0.7)
    for axis in axes.flat:
        axis.set_aspect("equal")
        axis.set_xlim(extent[:2])
        axis.set_ylim(extent[2:])
        axis.plot(0.0, 0.0, "w+", markersize=10)
    return figure


def main() -> None:
    """Read a scan, draw it, say how much is free and lethal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scan", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--profile", default="husky")
    parser.add_argument("--window-m", type=float, default=40.0)
    options = parser.parse_args()
    points_m = read_ply_points(options.scan)
    config = Config(model="terrain", profile=options.profile, window_m=options.window_m)
    draw_scan(points_m, config).savefig(options.picture, dpi=70)
    pose = sensor_over_ground(points_m)
    tilt = f"roll {np.degrees(pose.roll_rad):.1f}, pitch {np.degrees(pose.pitch_rad):.1f} degrees"
    print(f"{len(points_m)} points, sensor {pose.z_m:.2f} m over the ground, {tilt}: {options.picture}")


if __name__ == "__main__":
    main()
