"""Reports: one page that holds all it shows, of a mission, a campaign, a recording; and the moving picture."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from plgrim.evaluation.recorder import TRAJECTORY_COLUMNS
from plgrim.report.frames import LEGEND_PX, FrameMaker
from plgrim.report.gather import ReportError
from plgrim.report.page import write_report
from schemas.base import Pose
from schemas.contract import SECOND_NS
from schemas.operation import WorldPicture
from tests.runtime.fake_services import odometry


def _mission(folder: Path, events: list[dict[str, object]]) -> Path:
    folder.mkdir(parents=True)
    result = {
        "world": "maze <b>", "finish": "covered", "succeeded": True, "coverage_judge": 0.99, "distance_m": 12.5,
        "events": events, "left": [{"x_m": 1.0, "y_m": 2.0, "gain": 0.5, "reason": "out of reach"}],
        "coverage_by_belief": [[0.0, 0.1], [2.0, 0.9]], "versions": {"numpy": "2"},
        "stages": {"irm": {"steps": 3, "dropped": {"x:bad": 2, "y:bad": 3}}},
    }  # fmt: skip
    (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    rows = [",".join(TRAJECTORY_COLUMNS)] + [",".join([str(t)] * len(TRAJECTORY_COLUMNS)) for t in (0, 1, 2)]
    (folder / "trajectory.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    Image.new("RGB", (30, 20)).save(folder / "map.png")
    (folder / "config.yaml").write_text("seed: 3\n", encoding="utf-8")
    return folder


class _Addresses(HTMLParser):
    """Every address that a page asks for."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes them."""
        self.found += [v for k, v in attrs if k in ("src", "href", "xlink:href", "data", "action") and v]


def _asked_for(text: str) -> list[str]:
    parser = _Addresses()
    parser.feed(text)
    return [a for a in parser.found if not a.startswith(("data:", "#"))] + re.findall(
        r"url\((?!#)[^)]*\)|@import", text
    )


def test_the_page_of_a_mission_holds_everything_and_asks_nobody(tmp_path: Path) -> None:
    events: list[dict[str, object]] = [
        {"t_s": 1.5, "kind": "target", "text": "chose frontier 41: 38 cells <script>alert(1)</script>"}
    ]
    path = write_report(_mission(tmp_path / "run", events))
    text = path.read_text(encoding="utf-8")
    assert path == tmp_path / "run" / "report.html"
    assert _asked_for(text) == []
    for wanted in (
        "maze &lt;b&gt;",
        "covered",
        "99.0 %",
        "12.5 m",
        "chose frontier 41",
        "seed: 3",
        "out of reach",
    ):
        assert wanted in text
    assert text.count("<svg") == 4
    assert "<script>alert" not in text
    assert '<td class="num">5</td>' in text  # refused messages, summed up


def test_the_same_mission_gives_the_same_page(tmp_path: Path) -> None:
    folder = _mission(tmp_path / "run", [])
    assert (
        write_report(folder, tmp_path / "a").read_bytes() == write_report(folder, tmp_path / "b").read_bytes()
    )


def test_the_page_of_a_campaign_has_its_table_and_maps(tmp_path: Path) -> None:
    _mission(tmp_path / "runs" / "cave" / "default" / "seed_001", [])
    (tmp_path / "runs.csv").write_text("world,coverage\ncave,0.123456789\n", encoding="utf-8")
    (tmp_path / "summary.md").write_text("# Missions\n", encoding="utf-8")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert _asked_for(text) == []
    for wanted in ("cave/default/seed_001", "0.123457", "# Missions"):
        assert wanted in text


@pytest.mark.parametrize("content", ["", "[]", "{"])
def test_a_damaged_result_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "result.json").write_text(content, encoding="utf-8")
    with pytest.raises(ReportError, match=r"result\.json"):
        write_report(tmp_path)


def test_frames_show_the_drive_and_become_an_animation(tmp_path: Path) -> None:
    maker = FrameMaker(every_s=1.0, width_px=200)
    world = WorldPicture(stamp_ns=0, resolution_m=1.0, ix0=0, iy0=-10, cell=np.full((20, 40), 2, np.uint8))
    maker.observe(world, 0)
    for t in range(10):
        message = odometry(t * SECOND_NS, 3.0 * t).model_copy(update={"map_to_odom": Pose(y_m=2.0)})
        maker.observe(message, t * SECOND_NS)
    assert len(maker.frames) == 10
    assert maker.frames[0].size == (200, 100 + LEGEND_PX)
    first, last = (np.asarray(maker.frames[i]).astype(int) for i in (0, -1))
    rows, columns = np.nonzero(np.abs(first - last).sum(axis=2)[30:] > 100)
    assert columns.max() > 120  # the robot is at 27 of 40 m by now
    assert abs(int(np.median(rows)) + 30 - 40) <= 4  # 2 m over the middle of 20 m
    size = maker.save(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert image.n_frames == 10  # type: ignore[attr-defined]
    assert size < 100_000


def test_nothing_to_show_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no frame"):
        FrameMaker().save(tmp_path / "a.png")
