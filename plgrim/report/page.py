"""The page: a template filled in. It holds everything that it shows and asks no other host for anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from plgrim.report.draw import mission_curves
from plgrim.report.gather import Campaign, Mission, ReportError, facts, gather

_STAGE_COLUMNS = ("steps", "step_p50_ms", "step_p99_ms", "rate_hz", "memory_mb", "errors", "dropped")
_EMPTY: dict[str, Any] = {
    "subtitle": "", "warnings": [], "facts": [], "succeeded": False, "pictures": [], "pictures_title": "Map",
    "curves": [], "events": [], "kinds": [], "events_dropped": 0, "left": [], "stages": {},
    "stage_columns": _STAGE_COLUMNS, "rows": [], "columns": [], "runs": [], "left_out": 0, "summary": "",
    "parameters": "", "versions": {},
}  # fmt: skip


def page(found: Mission | Campaign) -> str:
    """The HTML of what was gathered."""
    environment = Environment(
        loader=PackageLoader("plgrim.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    values = _of_mission(found) if isinstance(found, Mission) else _of_campaign(found)
    return environment.get_template("page.html.j2").render({**_EMPTY, **values})


def _of_mission(mission: Mission) -> dict[str, Any]:
    result = mission.result
    events = result.get("events", [])
    stages = result.get("stages", {})
    used = [c for c in _STAGE_COLUMNS if any(c in row for row in stages.values())]
    return {
        "title": f"PLGRIM mission: {mission.name}",
        "subtitle": result.get("finish_text", ""),
        "warnings": result.get("warnings", []),
        "facts": facts(result),
        "succeeded": bool(result.get("succeeded")),
        "pictures": mission.pictures,
        "curves": mission_curves(mission.track, result),
        "events": events,
        "kinds": sorted({event["kind"] for event in events}),
        "events_dropped": result.get("events_dropped", 0),
        "left": result.get("left", []),
        "stages": stages,
        "stage_columns": used,
        "parameters": mission.parameters,
        "versions": result.get("versions", {}),
    }


def _of_campaign(campaign: Campaign) -> dict[str, Any]:
    return {
        "title": f"PLGRIM campaign: {campaign.name}",
        "subtitle": f"{len(campaign.rows)} runs",
        "pictures": campaign.pictures,
        "pictures_title": "Coverage",
        "rows": campaign.rows,
        "columns": campaign.columns,
        "runs": campaign.runs,
        "left_out": campaign.left_out,
        "summary": campaign.summary,
    }


def write_report(path: Path, out: Path | None = None) -> Path:
    """Write the report of a result folder, a campaign's folder or a recording; gives its path.

    Default: report.html in the folder, or beside the file. Raises ReportError, RecordingError.
    """
    text = page(gather(path))
    out = out or (path / "report.html" if path.is_dir() else path.with_suffix(".html"))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    return out


def write_animation(path: Path, out: Path, every_s: float) -> Path:
    """Write the animation of a recording; gives its path. Raises ReportError, RecordingError."""
    from plgrim.recording.reader import read_raw
    from plgrim.report.frames import SHOWN, FrameMaker
    from schemas.codec import decode
    from schemas.topics import topic_named

    if out.suffix not in (".png", ".gif"):
        raise ReportError(f"--animate {out}: a name that ends with .png (animated PNG) or .gif is wanted")
    if path.is_dir() and (path / "result.json").exists():
        raise ReportError(f"{path}: an animation needs a recording: run the mission beside `plgrim record`")
    maker = FrameMaker(every_s=every_s)
    for raw in read_raw(path, lambda _: None, SHOWN.__contains__):
        topic = topic_named(raw.topic)
        maker.observe(decode(raw.payload, topic.message, topic.max_bytes)[0], raw.sent_ns)
    try:
        maker.save(out)
    except ValueError as error:
        raise ReportError(f"{path}: {error}") from error
    return out
