"""The page's controls in a real browser with a real mission stage behind them: each pressed, its effect seen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from services.mission.stage import Config as MissionConfig
from services.status.app import SharedStatus, StatusServer
from services.status.config import Config
from tests.status.browser import chromium, until
from tests.status.mission_behind import MissionBehind

pytestmark = pytest.mark.slow

TOKEN = "operator-token-for-the-tests"


@pytest.fixture
def shared(tmp_path: Path) -> SharedStatus:
    tokens = tmp_path / "tokens"
    tokens.write_text(f"operator local {TOKEN}\n", encoding="utf-8")
    tokens.chmod(0o600)
    return SharedStatus(Config(port=0, tokens_file=str(tokens)), "husky1")


@pytest.fixture
def behind(shared: SharedStatus) -> MissionBehind:
    return MissionBehind(shared, MissionConfig(auto_start=False))


@pytest.fixture
def page(shared: SharedStatus, behind: MissionBehind) -> Iterator[Any]:
    """The page as `plgrim demo` prints its address, over a mission that waits for its start."""
    server = StatusServer(shared)
    server.start()
    try:
        with chromium() as browser:
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            said: list[str] = []
            page.on("console", lambda m: said.append(m.text) if m.type in ("error", "warning") else None)
            page.goto(f"http://127.0.0.1:{server.port}/#token={TOKEN}")
            until(page, "plgrim.store.get('status')?.mission != null")
            assert said == [], "no complaint of the address that is printed"
            yield page
    finally:
        server.stop()


def _press(page: Any, name: str, phase: str, answer: str = "") -> None:
    until(page, f"!document.querySelector('#{name}').disabled")
    page.click(f"#{name}")
    until(page, f"plgrim.store.get('status').mission.phase === '{phase}'")
    until(page, f"document.querySelector('#answer').textContent.includes('{answer}')")


def _draw(page: Any, kind: str, left: float, right: float) -> None:
    """A rectangle on the map, between two shares of its width."""
    page.click(f"#draw-{kind}")
    box = page.locator("#map").bounding_box()
    for x, y in ((left, 0.4), (right, 0.4), (right, 0.6), (left, 0.6)):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    page.click("#draw-finish")


def test_every_control_does_to_the_mission_what_it_says(page: Any, behind: MissionBehind) -> None:
    assert page.url.endswith("/"), "the token is gone from the address bar"
    assert page.locator("#command-pause").is_disabled(), "it has not begun"
    _press(page, "command-start", "explore", "start")
    _press(page, "command-pause", "paused", "paused by the operator")
    until(page, "document.querySelector('#command-pause').disabled")
    _press(page, "command-resume", "explore")
    page.fill("#budget-minutes", "15")
    page.click("#set-budget")
    until(page, "plgrim.store.get('status').mission.time_budget_s === 900")
    until(page, "document.querySelector('.facts').textContent.includes('of 15 min')")
    _draw(page, "no_go", 0.4, 0.6)
    until(page, "document.querySelector('#answer').textContent.includes('robot stands in')")
    assert page.evaluate("document.querySelector('#answer').classList.contains('bad')")
    _draw(page, "no_go", 0.7, 0.8)
    until(page, "document.querySelectorAll('.fences li').length === 1")
    _draw(page, "geofence", 0.2, 0.65)
    until(page, "document.querySelectorAll('.fences li').length === 2")
    until(page, "plgrim.store.get('status').mission.fences_version === 2")
    page.click("button[aria-label^='Remove No-go']")
    until(page, "document.querySelectorAll('.fences li').length === 1")
    behind.x_m = 4.0  # it drove on
    _press(page, "command-home", "return")
    until(page, "!document.querySelector('#command-stop').disabled")
    page.click("#command-stop")
    _press(page, "command-stop-sure", "stopped")
    until(page, "document.querySelector('#command-stop').disabled")
