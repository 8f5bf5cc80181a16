"""The planner as a library: it explores somebody else's map, deterministically, and names what is wrong."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from planning.rays import visible_cells
from plgrim import Cloud, Explorer, ExplorerConfig, Grid, Plan
from plgrim.errors import ConfigError, ExplorerInputError
from schemas.operation import FinishReason
from tests.runtime.helpers import REPOSITORY

RESOLUTION_M = 0.2


def small_world() -> NDArray[np.bool_]:
    """Two rooms and a door between them, 8 m x 5 m."""
    world = np.zeros((25, 40), np.bool_)
    world[[0, -1]] = world[:, [0, -1]] = True
    world[:18, 20] = True
    return world


class Robot:
    """Sees 4 m all around and drives a second of each plan."""

    def __init__(self, explorer: Explorer, world: NDArray[np.bool_]) -> None:
        self.explorer, self.world = explorer, world
        self.known = np.full(world.shape, -1, np.int8)
        self.pose: tuple[float, float, float] = (1.5, 1.5, 0.0)

    def step(self) -> Plan:
        """Look, plan, drive."""
        seen = np.zeros(self.world.shape, np.uint8)
        x, y, yaw = self.pose
        visible_cells(
            self.world, x / RESOLUTION_M, y / RESOLUTION_M, 4.0 / RESOLUTION_M, yaw, 2.0 * math.pi, seen
        )
        around = np.pad(seen, 1)
        rows, columns = self.world.shape
        surface = sum(around[r : r + rows, c : c + columns] for r in range(3) for c in range(3)) > 0
        self.known[surface & self.world] = 100
        self.known[seen > 0] = 0
        plan = self.explorer.step(Grid(self.known, RESOLUTION_M), self.pose)
        if plan.moves:
            assert np.all(np.diff(plan.path[:, 3]) >= 0.0)
            self.pose = plan.after(1.0)[:3]
        return plan


def options(**changes: Any) -> dict[str, Any]:
    small = {"simulations": 400}
    return {
        "coverage": "known", "sensor_range_m": 4.0, "sensor_fov_deg": 360.0, "riskmap": {"window_m": 20.0},
        "irm": {"size": 21}, "reconciler": small, **changes,
    }  # fmt: skip


def test_known_explores_the_whole_map() -> None:
    robot = Robot(Explorer(options()), small_world())
    for _ in range(80):
        plan = robot.step()
        row, column = int(robot.pose[1] / RESOLUTION_M), int(robot.pose[0] / RESOLUTION_M)
        assert not robot.world[row, column]
        if plan.finished:
            break
    assert plan.finish is FinishReason.COVERED
    free = ~robot.world
    assert np.count_nonzero(robot.known[free] == 0) >= 0.98 * np.count_nonzero(free)


def test_sensor_coverage_takes_longer_than_knowing() -> None:
    """A sensor that sees 1.5 m has covered less than what is known when the map is known."""
    robot = Robot(Explorer(options(coverage="sensor", sensor_range_m=1.5)), small_world())
    for _ in range(12):
        plan = robot.step()
    assert 0.0 < plan.coverage < 0.9
    assert plan.moves and not plan.finished


def test_a_plan_is_of_the_grid_it_was_given_with() -> None:
    """The very step that shows a wall across the path gives a path that does not cross it."""
    explorer, world = Explorer(options()), np.zeros((50, 50), np.int8)
    world[:, 25:] = -1
    first = explorer.step(Grid(world, RESOLUTION_M), (3.0, 5.0, 0.0))
    assert first.moves and first.target_m is not None
    world[:, 20:25] = 100
    world[0:4, 20:25] = 0
    second = explorer.step(Grid(world, RESOLUTION_M), (3.0, 5.0, 0.0))
    cells = (second.path[:, :2] / RESOLUTION_M).astype(int)
    assert np.all(world[cells[:, 1], cells[:, 0]] == 0)


def test_same_inputs_same_bytes_and_a_snapshot_goes_on() -> None:
    robots = [Robot(Explorer(options()), small_world()) for _ in range(2)]
    for _ in range(3):
        for robot in robots:
            robot.step()
    assert robots[0].explorer.digest() == robots[1].explorer.digest()
    again = Explorer(options())
    again.restore(robots[0].explorer.snapshot())
    robots[0].explorer = again
    plans = [robot.step() for robot in robots]
    assert np.array_equal(plans[0].path, plans[1].path)
    assert again.digest() == robots[1].explorer.digest()


def test_a_cloud_is_taken() -> None:
    angles = np.linspace(-math.pi, math.pi, 720, endpoint=False)
    wall = np.minimum(
        4.0 / np.maximum(np.abs(np.cos(angles)), 1e-9), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-9)
    )
    points = np.stack([wall * np.cos(angles), wall * np.sin(angles), np.full(720, -0.4)], axis=1)
    explorer = Explorer(options(riskmap={"window_m": 20.0}))
    for _ in range(2):
        plan = explorer.step(Cloud(points.astype(np.float32), range_m=20.0), (0.0, 0.0, 0.0))
    assert plan.covered_area_m2 > 20.0


@pytest.mark.parametrize(
    ("cells", "resolution_m", "origin", "field"),
    [
        (np.zeros(4, np.int8), 0.1, (0.0, 0.0), "grid.cells"),
        (np.zeros((4, 4)), 0.1, (0.0, 0.0), "grid.cells"),
        (np.full((4, 4), 255, np.uint8), 0.1, (0.0, 0.0), "grid.cells: 255"),
        (np.zeros((4, 4), np.int8), 0.0, (0.0, 0.0), "grid.resolution_m"),
        (np.zeros((4, 4), np.int8), 0.1, (0.0, math.nan), "grid.origin_m"),
    ],
)
def test_a_grid_that_cannot_be_used_names_the_field(
    cells: NDArray[Any], resolution_m: float, origin: tuple[float, float], field: str
) -> None:
    with pytest.raises(ExplorerInputError, match=field):
        Grid(cells, resolution_m, origin)


def test_other_encodings() -> None:
    grid = Grid.of_values(np.array([[255, 0], [127, 255]]), 0.1, free=255, occupied=0, unknown=127)
    assert grid.cells.tolist() == [[0, 100], [-1, 0]]
    with pytest.raises(ExplorerInputError, match=r"grid\.values: .*3"):
        Grid.of_values(np.array([[3]]), 0.1, free=255, occupied=0, unknown=127)


def test_poses_and_times_are_checked() -> None:
    explorer, grid = Explorer(options()), Grid(np.zeros((20, 20), np.int8), 0.2)
    with pytest.raises(ExplorerInputError, match="pose"):
        explorer.step(grid, (1.0, 2.0))
    with pytest.raises(ExplorerInputError, match="pose"):
        explorer.step(grid, (1.0, math.inf, 0.0))
    with pytest.raises(ExplorerInputError, match="seconds"):
        explorer.step(grid, (1.0, 2.0, 0.0), seconds=0.0)
    with pytest.raises(ExplorerInputError, match="seen"):
        explorer.step(np.zeros((3, 3)), (1.0, 2.0, 0.0))  # type: ignore[arg-type]


def test_a_misspelt_key_is_refused_with_a_hint(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"sensor_rang.*sensor_range_m"):
        Explorer({"sensor_rang": 3.0})
    with pytest.raises(ConfigError, match=r"irm\.spacing.*spacing_m"):
        Explorer({"irm": {"spacing": 2.0}})
    file = tmp_path / "explorer.yaml"
    file.write_text("sensor_range_m: -1\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="sensor_range_m"):
        ExplorerConfig.of(file)


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """The example, as the README shows it, explores its map."""
    source = (REPOSITORY / "examples" / "explorer.py").read_text(encoding="utf-8")
    runpy.run_path(str(REPOSITORY / "examples" / "explorer.py"))
    assert capsys.readouterr().out.startswith("covered: 1")
    readme = (REPOSITORY / "plgrim" / "README.md").read_text(encoding="utf-8")
    assert source.split('"""\n\n', 1)[1] in readme
