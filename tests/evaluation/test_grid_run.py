"""PLGRIM under the grid protocols: projection, a small map end to end, tables, and maps that were driven before."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from plgrim.errors import ConfigError
from plgrim.evaluation.grid_drive import Projection, drive, occupancy
from plgrim.evaluation.grid_kernels import OPEN, SOLID, UNSEEN
from plgrim.evaluation.grid_rules import make_world
from plgrim.evaluation.grid_run import PARAMETERS, kept_row, plan_tasks, run_map, write_tables
from plgrim.explorer import ExplorerConfig, Plan
from schemas.operation import FinishReason
from schemas.policy import LocalPhase
from tests.evaluation.test_grid_rules import room_map


def plan(path: np.ndarray | None = None, target_m: tuple[float, float] | None = None) -> Plan:
    found = np.zeros((0, 4)) if path is None else np.column_stack([path, np.zeros((len(path), 2))])
    return Plan(found, target_m, 0.0, LocalPhase.COVER, "", "", False, FinishReason.NONE, "", 0.0, 0.0)


def test_blocks_are_free_when_all_cells_are_and_occupied_when_any_is() -> None:
    belief = np.full((4, 6), OPEN, np.uint8)
    belief[0, 2], belief[0, 4], belief[1, 5] = UNSEEN, UNSEEN, SOLID
    assert occupancy(belief, 2).tolist() == [[0, -1, 100], [0, 0, 0]]


def test_the_projection_follows_the_path() -> None:
    world = make_world(room_map("dare"), "dare")
    here = (world.node[world.at] + 0.5) * 0.24
    east = np.column_stack([here[0] + np.linspace(0.0, 5.0, 51), np.full(51, here[1])])
    node = Projection(world, 0.24).choose(plan(east))
    assert (world.place[node] - world.place[world.at])[0] > 0.0
    west = Projection(world, 0.24).choose(plan(2.0 * here - east))
    assert (world.place[west] - world.place[world.at])[0] < 0.0


def test_without_a_path_the_target_leads_and_without_either_the_protocol() -> None:
    world = make_world(room_map("dare"), "dare")
    here = (world.node[world.at] + 0.5) * 0.24
    projection = Projection(world, 0.24)
    projection.choose(plan(target_m=(float(here[0]) + 5.0, float(here[1]))))
    projection.choose(plan())
    assert projection.how == {"target": 1, "protocol's nearest": 1}


def test_two_plans_of_equal_worth_do_not_send_it_to_and_fro() -> None:
    """A path that points the other way at every step does not make the robot swing between two nodes for ever."""
    world = make_world(room_map("dare"), "dare")
    projection, visited = Projection(world, 0.24), []
    for step in range(40):
        here = (world.node[world.at] + 0.5) * 0.24
        sign = 1.0 if step % 2 == 0 else -1.0
        node = projection.choose(
            plan(np.column_stack([here[0] + sign * np.linspace(0.0, 3.0, 31), np.full(31, here[1])]))
        )
        if node < 0 or world.done:
            break
        world.move(node)
        visited.append(tuple(world.node[world.at].tolist()))
    assert len(set(visited)) > 6


def small_file(folder: Path) -> Path:
    """A map as the protocol stores it: a room of 120 x 100 px and a side room."""
    gray = np.full((480, 640), 127, np.uint8)
    gray[100:200, 100:220] = gray[140:170, 220:280] = gray[120:190, 280:340] = 195
    gray[150:166, 150:166] = 208
    image = folder / "maps" / "ariadne_small" / "img_1.png"
    image.parent.mkdir(parents=True)
    Image.fromarray(gray).save(image)
    return image


def test_a_small_map_end_to_end(tmp_path: Path) -> None:
    image = small_file(tmp_path)
    (tmp_path / "maps" / "peers_ariadne.csv").write_text(
        "set,map,nearest_px,utility_px,set_cover_tsp_px,full_map_tour_px\n"
        "ariadne_small,img_1.png,400,300,250,200\n",
        encoding="utf-8",
    )
    (task,) = plan_tasks(tmp_path / "maps", "ariadne", tmp_path / "out", PARAMETERS, None, pictures=True)
    assert task.image == image and task.reference == 250.0
    row = run_map(task)
    assert row["finished"] and row["unseen_cells"] >= 0
    assert row["ratio"] == pytest.approx(row["travel"] / 250.0, abs=1e-4)
    assert task.result.with_suffix(".png").stat().st_size > 1000
    assert kept_row(task) == row
    assert kept_row(replace(task, identity="other")) is None
    text = write_tables([row], "ariadne", tmp_path / "out", "command")
    assert "| ariadne_small | 1 | 1 |" in text and "Not finished: none" in text
    with (tmp_path / "out" / "maps.csv").open(encoding="utf-8") as file:
        assert float(next(csv.DictReader(file))["travel"]) == row["travel"]


def test_the_same_map_twice_gives_the_same_way() -> None:
    parameters = ExplorerConfig.of(PARAMETERS)
    tracks = [
        drive(make_world(room_map("dare"), "dare"), "dare", parameters, most_moves=6).track for _ in range(2)
    ]
    assert np.array_equal(tracks[0], tracks[1])


def test_wrong_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no folder"):
        plan_tasks(tmp_path / "none", "dare", tmp_path, PARAMETERS, None, False)
    with pytest.raises(ConfigError, match="no PNG"):
        plan_tasks(tmp_path, "dare", tmp_path, PARAMETERS, None, False)
