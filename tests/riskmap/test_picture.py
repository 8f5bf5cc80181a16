"""The picture of a scan, and the risk map of a real one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from planning.grid import FREE, LETHAL
from schemas.base import Pose
from services.riskmap.config import Config
from services.riskmap.picture import draw_scan, read_ply_points, scan_layers, sensor_over_ground
from tests.riskmap.rough import plane, scan

CONFIG = Config(model="terrain", profile="husky", window_m=20.0)


def test_the_sensors_height_and_tilt_are_found_from_the_ground() -> None:
    points = scan(plane(0.1, -0.05), Pose(), 360)
    pose = sensor_over_ground(points)
    assert pose.z_m == pytest.approx(0.8, abs=0.02)
    assert pose.pitch_rad == pytest.approx(np.arctan(0.1), abs=0.01)
    assert pose.roll_rad == pytest.approx(np.arctan(0.05), abs=0.01)
    with pytest.raises(ValueError, match="too few points"):
        sensor_over_ground(points[:3])


def test_a_scan_is_drawn() -> None:
    figure = draw_scan(scan(plane(0.1), Pose(), 360), CONFIG)
    assert len(figure.axes) == 8


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(ValueError, match="not a binary little-endian PLY"):
        read_ply_points(path)


def test_in_a_real_scan_ground_is_free_and_upright_things_are_not(
    third_party_data: Callable[[str], Path],
) -> None:
    points = read_ply_points(third_party_data("mesh3d/small_gicp_source.ply"))
    assert points.shape == (69_792, 3)
    spec, layers, elevation_m = scan_layers(points, Config(model="terrain", profile="husky"))
    pose = sensor_over_ground(points)
    assert 1.0 < pose.z_m < 2.5
    share = float((layers.state == FREE).mean()) * 40.0**2
    assert 60.0 < share < 200.0
    assert np.percentile(np.abs(elevation_m[layers.state == FREE]), 90) < 0.2
    assert (layers.state == LETHAL).sum() > 300
    # The long wall left of the sensor (from (-3, 2.3) to (7.5, 4.2)) and the one ahead of its right.
    for x, y in ((0.0, 2.75), (3.0, 3.3), (6.0, 3.85), (6.0, -5.5)):
        row, column = spec.cell_of(x, y)
        assert (layers.state[row - 3 : row + 4, column - 3 : column + 4] == LETHAL).any(), (x, y)
    for x, y in ((0.0, -4.0), (6.0, 1.0), (-4.0, -0.5), (2.0, 1.0)):
        row, column = spec.cell_of(x, y)
        assert (layers.state[row - 3 : row + 4, column - 3 : column + 4] == FREE).mean() > 0.9, (x, y)
