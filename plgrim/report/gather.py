"""Gathers what a report shows: from a result folder, a campaign's folder, or a recording."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from plgrim.errors import PlgrimError

_MOST_RUNS = 60
_THUMB_PX = 560
_SUFFIX = {".mcap"}


class ReportError(PlgrimError):
    """Nothing there that a report could be made of; the text names what is wanted."""

    exit_code = 2


@dataclass(slots=True)
class Mission:
    """One mission. track: rows of trajectory.csv by column. figures: (title, data URI or SVG) in order."""

    name: str
    result: dict[str, Any]
    track: dict[str, list[float]] = field(default_factory=dict)
    pictures: list[tuple[str, str]] = field(default_factory=list)
    parameters: str = ""


@dataclass(slots=True)
class Campaign:
    """Many missions: their table and a small map of each."""

    name: str
    summary: str
    columns: list[str]
    rows: list[list[str]]
    pictures: list[tuple[str, str]] = field(default_factory=list)
    runs: list[tuple[str, str]] = field(default_factory=list)
    left_out: int = 0


def gather(path: Path) -> Mission | Campaign:
    """What there is at a path. Raises ReportError, RecordingError."""
    if not path.exists():
        raise ReportError(
            f"{path}: not there: name the result folder of a mission or campaign, or a recording"
        )
    if path.is_file() and path.suffix in _SUFFIX:
        return _recording(path)
    if path.is_dir() and (path / "result.json").exists():
        return _mission(path)
    if path.is_dir() and (path / "runs.csv").exists():
        return _campaign(path)
    if path.is_dir() and any(".mcap" in p.name for p in path.iterdir()):
        return _recording(path)
    raise ReportError(
        f"{path}: holds neither result.json (`plgrim explore`, `demo`, `up`), nor runs.csv (`plgrim evaluate`), "
        "nor .mcap files (`plgrim record`)"
    )


def data_uri(picture: bytes, kind: str = "image/png") -> str:
    """A picture as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(picture).decode()}"


def _picture(path: Path, width_px: int = 0) -> str:
    if not width_px:
        return data_uri(path.read_bytes())
    with Image.open(path) as image:
        small = image.convert("RGB")
        small.thumbnail((width_px, width_px))
        out = io.BytesIO()
        small.quantize(64).save(out, "PNG", optimize=True)
    return data_uri(out.getvalue())


def read_track(path: Path) -> dict[str, list[float]]:
    """Columns of a trajectory.csv."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in (rows[0] if rows else {})}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ReportError(f"{path}: cannot be read: {error}; run the mission again") from error
    if not isinstance(found, dict):
        raise ReportError(f"{path}: not a result of `plgrim explore`: a JSON object is wanted")
    return found


def _mission(folder: Path) -> Mission:
    result = _read_json(folder / "result.json")
    mission = Mission(str(result.get("world", folder.name)), result)
    if (folder / "trajectory.csv").exists():
        mission.track = read_track(folder / "trajectory.csv")
    for file, title in (
        ("map.png", "The world, what was covered, and the driven path"),
        ("tour.png", "The peer"),
    ):
        if (folder / file).exists():
            mission.pictures.append((title, _picture(folder / file)))
    if (folder / "config.yaml").exists():
        mission.parameters = (folder / "config.yaml").read_text(encoding="utf-8")
    return mission


def _recording(path: Path) -> Mission:
    """The same as the mission's own result, made from the messages."""
    import tempfile

    from plgrim.evaluation.recorder import RECORDED, MissionRecorder
    from plgrim.recording.reader import read_about, read_raw
    from schemas.codec import decode
    from schemas.recording import StageSnapshot
    from schemas.topics import topic_named

    about = read_about(path)
    wanted = {topic.name for topic in RECORDED}
    recorder = MissionRecorder(0, about.get("world", "-"), "recording")
    warnings: list[str] = []
    options: dict[str, Any] = {}
    seed = int(about.get("seed", 0))
    for raw in read_raw(path, warnings.append, lambda name: name in wanted or name.endswith("/snapshot")):
        topic = topic_named(raw.topic)
        message, envelope = decode(raw.payload, topic.message, topic.max_bytes)
        if raw.topic.endswith("/snapshot"):
            assert isinstance(message, StageSnapshot)
            options[raw.writer], seed = json.loads(message.options), message.seed
            continue
        recorder.observe(topic, message, envelope.sent_ns, envelope.epoch)
    with tempfile.TemporaryDirectory() as folder:
        recorder.write(Path(folder))
        mission = _mission(Path(folder))
    if options:
        import yaml

        mission.parameters = yaml.safe_dump(options, sort_keys=True)
    mission.result.update(warnings=warnings, seed=seed)
    return mission


def _campaign(folder: Path) -> Campaign:
    with (folder / "runs.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.reader(file))
    summary = folder / "summary.md"
    found = Campaign(
        folder.resolve().name,
        summary.read_text(encoding="utf-8") if summary.exists() else "",
        table[0] if table else [],
        [[_rounded(cell) for cell in row] for row in table[1:]],
    )
    if (folder / "coverage.png").exists():
        found.pictures.append(("Coverage over time", _picture(folder / "coverage.png")))
    maps = sorted((folder / "runs").rglob("map.png"))
    found.left_out = max(0, len(maps) - _MOST_RUNS)
    for path in maps[:_MOST_RUNS]:
        found.runs.append((path.parent.relative_to(folder / "runs").as_posix(), _picture(path, _THUMB_PX)))
    return found


def _rounded(cell: str) -> str:
    try:
        return f"{float(cell):g}"
    except ValueError:
        return cell


def facts(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The head of a mission's page."""

    def share(name: str) -> str:
        value = result.get(name)
        return "-" if value is None else f"{100 * float(value):.1f} %"

    def number(name: str, unit: str) -> str:
        value = result.get(name)
        return "-" if value is None else f"{float(value):.1f} {unit}"

    left = result.get("left") or []
    return [
        ("finish", str(result.get("finish") or "not finished")),
        ("coverage (judge)", share("coverage_judge")),
        ("coverage (belief)", share("coverage_belief")),
        ("driven", number("distance_m", "m")),
        ("mission time", number("elapsed_s", "s")),
        ("covered", f"{number('covered_area_m2', 'm²')} of {number('reachable_area_m2', 'm²')}"),
        ("target switches", str(result.get("target_switches", "-"))),
        ("contacts", str(result.get("contacts", "-"))),
        ("left", f"{len(left)} places"),
        ("seed", str(result.get("seed", "-"))),
        ("mode", str(result.get("mode", "-"))),
    ]
