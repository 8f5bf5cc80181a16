"""Segments over a link: what is missing comes, once, whole, also when the link is cut in the middle."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from plgrim.config import Config
from plgrim.recording.errors import RecordingError
from plgrim.recording.transfer import Fetcher, Offer
from plgrim.runtime.zenoh_session import Link, connect


def _write(folder: Path, number: int, size: int) -> Path:
    path = folder / f"20260101T000000-{number:06d}.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes((number * 7 + i) % 251 for i in range(size)))
    return path


def test_all_segments_come_and_only_those_that_are_missing(
    link: Link, config: Config, tmp_path: Path
) -> None:
    robot, base = tmp_path / "robot", tmp_path / "base"
    for number in (1, 2):
        _write(robot, number, 150_000)
    (robot / "20260101T000000-000003.mcap.part").write_bytes(b"being written")
    Offer(robot).on(link.session, config.robot)
    with connect(config.router, config.robot, threading.Event(), 20.0) as other:
        fetcher = Fetcher(other, base, kilobytes_per_s=1e6, timeout_s=20.0)
        assert fetcher.round(threading.Event()) == 0
        assert fetcher.fetched == 2
        _write(robot, 4, 10)
        assert fetcher.round(threading.Event()) == 0
    assert fetcher.fetched == 3
    whole = {path.name: path.read_bytes() for path in robot.glob("*.mcap")}
    assert {path.name: path.read_bytes() for path in base.iterdir()} == whole


def test_fetching_goes_on_where_a_cut_ended_it(link: Link, config: Config, tmp_path: Path) -> None:
    path = _write(tmp_path / "robot", 1, 200_000)
    with connect(config.router, config.robot, threading.Event(), 20.0) as robot:
        Offer(tmp_path / "robot").on(robot.session, config.robot)
        fetcher = Fetcher(link, tmp_path / "base", kilobytes_per_s=1e6, timeout_s=20.0)
        listed = json.loads(Offer(tmp_path / "robot").answer({}))[0]
        (tmp_path / "base").mkdir()
        (tmp_path / "base" / f"{path.name}.part").write_bytes(
            path.read_bytes()[:100_000]
        )  # from before the cut
        asked: list[str] = []
        ask = Fetcher._ask
        assert listed["bytes"] == 200_000

        def noted(self: Fetcher, parameters: str) -> bytes | None:
            asked.append(parameters)
            return ask(self, parameters)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Fetcher, "_ask", noted)
            assert fetcher.round(threading.Event()) == 0
        assert asked[1].endswith("offset=100000")
    assert (tmp_path / "base" / path.name).read_bytes() == path.read_bytes()
    fetcher.timeout_s = 1.0
    assert fetcher.round(threading.Event()) == -1  # the robot is gone


def test_what_was_damaged_is_fetched_anew(link: Link, config: Config, tmp_path: Path) -> None:
    path = _write(tmp_path / "robot", 1, 100_000)
    Offer(tmp_path / "robot").on(link.session, config.robot)
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / f"{path.name}.part").write_bytes(b"x" * 50_000)
    with connect(config.router, config.robot, threading.Event(), 20.0) as other:
        fetcher = Fetcher(other, tmp_path / "base", kilobytes_per_s=1e6, timeout_s=20.0)
        fetcher.round(threading.Event())
        assert fetcher.damaged == 1
        assert fetcher.round(threading.Event()) == 0
    assert (tmp_path / "base" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("name", ["../evil.mcap", "/etc/passwd", "x.txt"])
def test_names_from_the_wire_are_no_paths(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no segment"):
        Offer(tmp_path).answer({"name": name})
    with pytest.raises(RecordingError, match="not the name of a segment"):
        Fetcher(None, tmp_path)._has({"name": name, "bytes": 1})  # type: ignore[arg-type]
