"""`plgrim start|pause|resume|home|stop|budget|geofence|nogo|priority|fences`: steer a running mission.

Each asks the status service of the robot over Zenoh and prints the mission's own answer. Exit codes: 0 carried out,
1 refused, 2 a file or an option that does not fit, 5 no router, 8 no answer.
"""

from __future__ import annotations

import json
import threading
import uuid
from pathlib import Path
from typing import Annotated, Any

import typer

from plgrim.commands.options import ConfigFile

_TIMEOUT_S = 10.0
Key = Annotated[
    str | None, typer.Option("--key", help="Of your choice: a command with the same key is carried out once.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")]
Frame = Annotated[
    str | None,
    typer.Option(help="map or odom; not needed when the file says it (a member `frame`)."),
]
GeoFile = Annotated[Path, typer.Argument(help="GeoJSON: polygons in metres of the frame.")]


def ask_mission(body: dict[str, Any] | None, config_file: Path | None) -> dict[str, Any]:
    """The answer to a command, or to nothing: the fences. Raises PlgrimError, also when the mission refuses."""
    from plgrim.config import load_config
    from plgrim.errors import CommandRefusedError, ConfigError, NoAnswerError
    from plgrim.runtime.status_service import command_key
    from plgrim.runtime.zenoh_session import connect
    from plgrim.security.access import OPERATOR
    from plgrim.security.exposure import check_client

    config = load_config(config_file)
    check_client(config, OPERATOR)
    payload = b"" if body is None else json.dumps(body).encode()
    timeout_s = config.runtime.router_timeout_s
    with connect(config.router, config.robot, threading.Event(), timeout_s, OPERATOR) as link:
        reply = link.ask(command_key(config.robot), _TIMEOUT_S, payload)
    if reply is None:
        raise NoAnswerError(
            f"the status service of robot {config.robot!r} does not answer at {config.router.client_endpoint}: "
            "is the mission running (`plgrim up`), and is this the right robot (PLGRIM_ROBOT)?"
        )
    answer: dict[str, Any] = json.loads(reply)
    status = answer.get("status", 200)
    if status == 422:
        raise ConfigError(answer["detail"])
    if status != 200:
        raise NoAnswerError(answer["detail"])
    if answer.get("accepted") is False:
        raise CommandRefusedError(f"refused: {answer['reason']}")
    return answer


def _carry_out(kind: str, key: str | None, as_json: bool, config_file: Path | None, **more: Any) -> None:
    body = {"kind": kind, "command_id": key or uuid.uuid4().hex, **more}
    answer = ask_mission(body, config_file)
    print(json.dumps(answer, indent=2) if as_json else answer["reason"])


def start(key: Key = None, as_json: AsJson = False, config_file: ConfigFile = None) -> None:
    """Start a mission that waits for it (mission.auto_start: false). Example: plgrim start"""
    _carry_out("start", key, as_json, config_file)


def pause(key: Key = None, as_json: AsJson = False, config_file: ConfigFile = None) -> None:
    """Stop where the robot is, until `plgrim resume`. Example: plgrim pause"""
    _carry_out("pause", key, as_json, config_file)


def resume(key: Key = None, as_json: AsJson = False, config_file: ConfigFile = None) -> None:
    """Go on with what was paused. Example: plgrim resume"""
    _carry_out("resume", key, as_json, config_file)


def home(key: Key = None, as_json: AsJson = False, config_file: ConfigFile = None) -> None:
    """Return to where the mission began, and end there. Example: plgrim home"""
    _carry_out("home", key, as_json, config_file)


def stop(key: Key = None, as_json: AsJson = False, config_file: ConfigFile = None) -> None:
    """End the mission where the robot is. Example: plgrim stop"""
    _carry_out("stop", key, as_json, config_file)


def budget(
    seconds: Annotated[float, typer.Argument(min=0, help="Mission time from start to end; 0: no limit.")],
    key: Key = None,
    as_json: AsJson = False,
    config_file: ConfigFile = None,
) -> None:
    """Change the time budget. Example: plgrim budget 900"""
    _carry_out("budget", key, as_json, config_file, time_budget_s=seconds)


def geofence(
    file: GeoFile,
    frame: Frame = None,
    key: Key = None,
    as_json: AsJson = False,
    config_file: ConfigFile = None,
) -> None:
    """Keep the robot inside polygons; they replace the geofence before. Example: plgrim geofence site.geojson --frame
    map"""
    _draw("geofence", file, frame, key, as_json, config_file)


def nogo(
    file: GeoFile,
    frame: Frame = None,
    key: Key = None,
    as_json: AsJson = False,
    config_file: ConfigFile = None,
) -> None:
    """Keep the robot out of polygons. Example: plgrim nogo pit.geojson --frame map"""
    _draw("no_go", file, frame, key, as_json, config_file)


def priority(
    file: GeoFile,
    frame: Frame = None,
    weight: Annotated[
        float, typer.Option(min=1, max=10, help="So many times the ground inside counts.")
    ] = 3.0,
    key: Key = None,
    as_json: AsJson = False,
    config_file: ConfigFile = None,
) -> None:
    """Explore polygons first. Example: plgrim priority office.geojson --frame map --weight 5"""
    _draw("priority", file, frame, key, as_json, config_file, weight=weight)


def fences(
    remove: Annotated[list[str] | None, typer.Option(help="Take this fence away; may be repeated.")] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Take all fences away.")] = False,
    key: Key = None,
    as_json: AsJson = False,
    config_file: ConfigFile = None,
) -> None:
    """List the fences, or take some away. Example: plgrim fences --remove no_go-1"""
    if remove and clear:
        raise typer.BadParameter("--remove and --clear exclude each other")
    if remove or clear:
        _carry_out("unfence", key, as_json, config_file, fence_ids=remove or [])
        return
    held = ask_mission(None, config_file)
    if as_json:
        print(json.dumps(held, indent=2))
        return
    for feature in held["features"]:
        told = feature["properties"]
        corners = len(feature["geometry"]["coordinates"][0]) - 1
        print(
            f"{feature['id']}: {told['kind']} in {told['frame']}, {corners} corners {told['name']}".rstrip()
        )
    if not held["features"]:
        print("no fences")


def _draw(
    kind: str,
    file: Path,
    frame: str | None,
    key: str | None,
    as_json: bool,
    config_file: Path | None,
    **more: Any,
) -> None:
    from plgrim.errors import ConfigError

    try:
        geojson = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read as GeoJSON: {error}") from error
    if not isinstance(geojson, dict):
        raise ConfigError(
            f"{file}: holds no GeoJSON object; write a Polygon, a Feature or a FeatureCollection"
        )
    chosen = frame or geojson.get("frame")
    if chosen not in ("map", "odom"):
        raise ConfigError(f"{file}: frame: {chosen!r} is neither map nor odom; say --frame map")
    drawn = {"kind": kind, "frame": chosen, "geojson": geojson, "name": file.stem[:128], **more}
    try:
        _carry_out("fence", key, as_json, config_file, fence=drawn)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    for command in (start, pause, resume, home, stop, budget, geofence, nogo, priority, fences):
        app.command()(command)
