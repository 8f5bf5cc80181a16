"""The documents say what is true: tables, commands, options, paths and links are checked against the project."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import typer.main

from plgrim.cli import application
from plgrim.commands.inspect import topic_table
from plgrim.config import check_all, check_service, load_config
from plgrim.registry import STAGES
from schemas.topics import SERVICES
from services.sim.worlds import WORLD_NAMES
from services.status.app import SharedStatus, create_app
from services.status.config import Config as StatusConfig
from services.status.geojson import FenceRequest

ROOT = Path(__file__).resolve().parent.parent
_SKIPPED = {"node_modules", "build", "dist", "out", "results"}
DOCUMENTS = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not any(part in _SKIPPED or part.startswith(".") for part in path.relative_to(ROOT).parts[:-1])
)
README = (ROOT / "README.md").read_text(encoding="utf-8")
_CODE = re.compile(r"```\w*\n(.*?)```|`([^`\n]+)`", re.DOTALL)
_MACHINE_PATH = re.compile(r"(?<![\w.~:/])/(?:home|root|work|tmp|Users|mnt|opt)\b[^\s`]*")


def named(path: Path) -> str:
    """The document's path as test id."""
    return path.relative_to(ROOT).as_posix()


def code_lines(text: str) -> list[str]:
    """The lines of a document that are code, without comments."""
    pieces = [block or span for block, span in _CODE.findall(text)]
    return [line.split(" #")[0].strip() for piece in pieces for line in piece.splitlines()]


def commands() -> dict[str, set[str]]:
    """The options of each command of the program; a group of commands has those of all its commands."""
    group: Any = typer.main.get_command(application)  # of typer's own copy of click
    return {name: options(command) for name, command in group.commands.items() if not command.hidden}


def options(command: Any) -> set[str]:
    """Of a command and of those below it."""
    below = getattr(command, "commands", {}).values()
    own = {option for parameter in command.params for option in parameter.opts}
    return {"--help"}.union(own, *(options(inner) for inner in below))


def calls(text: str) -> list[tuple[str, str]]:
    """(command, rest of the line) of each call of the program in a document's code."""
    found = []
    for line in code_lines(text):
        for call in re.split(r"[;&|]+", line):
            match = re.search(r"(?:^|\s|/)(?<!from )plgrim ([a-z]+)\b(.*)", call)
            if match is not None:
                found.append((match[1], match[2]))
    return found


def test_the_table_of_topics_is_the_generated_one() -> None:
    table = README.split("<!-- topics: begin -->\n")[1].split("\n<!-- topics: end -->")[0]
    assert table == topic_table(), "put the output of `plgrim topics` between the two marks in README.md"


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_every_command_that_is_named_exists_with_its_options(path: Path) -> None:
    known = commands()
    for name, rest in calls(path.read_text(encoding="utf-8")):
        assert name in known, f"there is no `plgrim {name}`"
        for option in re.findall(r"(?<=\s)--[a-z-]+", rest):
            assert option in known[name], f"`plgrim {name}` has no {option}"


def test_the_readme_names_every_command_service_and_world() -> None:
    assert {name for name, _ in calls(README)} >= set(commands())
    assert all(f"(services/{name}/README.md)" in README for name in SERVICES)
    assert all(f"`{name}`" in README for name in WORLD_NAMES)


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_every_make_target_that_is_named_exists(path: Path) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for line in code_lines(path.read_text(encoding="utf-8")):
        for target in re.findall(r"(?:^|\s)make ([a-z][a-z-]*)", line):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"there is no `make {target}`"


def test_every_http_path_of_the_readme_answers() -> None:
    table = README.split("### Status over HTTP")[1].split("\n### ")[0]
    app = create_app(SharedStatus(StatusConfig(), "robot"))
    routes = {getattr(route, "path", "") for route in app.routes} | set(app.openapi()["paths"])
    named_paths = re.findall(r"^\| `(/[^`]*)`", table, re.MULTILINE)
    assert len(named_paths) >= 5
    assert set(named_paths) <= routes


def test_the_example_of_a_configuration_is_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("PLGRIM_CONFIG", "PLGRIM_ROBOT", "PLGRIM_SEED", "PLGRIM_SPEED", "PLGRIM_ROUTER"):
        monkeypatch.delenv(variable, raising=False)
    block = re.search(r"<!-- example: a valid configuration.*?-->\n```yaml\n(.*?)```", README, re.DOTALL)
    assert block is not None
    file = tmp_path / "example.yaml"
    file.write_text(block[1], encoding="utf-8")
    config = load_config(file)
    check_all(config)
    assert config.robot == "spot1"
    for service in (*STAGES, "status"):
        assert check_service(config, service) is not None


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_no_document_names_a_path_of_a_machine(path: Path) -> None:
    assert _MACHINE_PATH.findall(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_every_link_within_the_project_leads_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if not re.match(r"https?:|#", target):
            assert (path.parent / target.split("#")[0]).exists(), f"{target} does not exist"


def test_every_room_has_a_readme() -> None:
    rooms = ["schemas", "planning", "plgrim", *(f"services/{name}" for name in SERVICES)]
    assert [room for room in rooms if not (ROOT / room / "README.md").is_file()] == []


def test_the_polygon_of_the_walk_is_one_and_says_its_frame() -> None:
    file = json.loads((ROOT / "examples" / "corner.geojson").read_text(encoding="utf-8"))
    assert "plgrim nogo examples/corner.geojson" in README
    (fence,) = FenceRequest.model_validate(
        {"kind": "no_go", "frame": file["frame"], "geojson": file}
    ).fences()
    assert len(fence.rings[0].points) == 5
