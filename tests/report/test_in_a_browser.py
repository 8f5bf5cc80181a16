"""The report in a real browser: nothing is asked for, nothing is wider than a phone, all of it is readable."""

from __future__ import annotations

from pathlib import Path

import pytest

from plgrim.report.page import write_report
from tests.report.test_report import _mission
from tests.status.browser import chromium
from tests.status.test_contrast import contrast

pytestmark = pytest.mark.slow

_COLOURS = """[...document.querySelectorAll("figcaption, dt, dd, td, th, h1, h2, p, summary")]
  .filter((e) => e.innerText).map((e) => {
    let under = e;
    while (under && getComputedStyle(under).backgroundColor === "rgba(0, 0, 0, 0)") under = under.parentElement;
    const ground = under ? getComputedStyle(under).backgroundColor : "rgb(255, 255, 255)";
    return [e.tagName, getComputedStyle(e).color, ground];
  })"""
_CUT = """[...document.querySelectorAll(".events, .wide:not(.stages)")]
  .filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => [e.ariaLabel, e.scrollWidth, e.clientWidth])"""


def _hex(colour: str) -> str:
    red, green, blue = (int(part) for part in colour.strip("rgba()").split(",")[:3])
    return f"#{red:02x}{green:02x}{blue:02x}"


@pytest.fixture
def report(tmp_path: Path) -> Path:
    why = "out of reach: no way to it that the robot fits through"
    events: list[dict[str, object]] = [
        {"t_s": -1e-9, "kind": "mission", "text": "idle: waiting for odometry"},
        {"t_s": 1204.5, "kind": "given up", "text": f"frontier at (-107.6, -101.4) given up: {why}"},
    ]
    return write_report(_mission(tmp_path / "run", events))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_it_is_read_without_scrolling_sideways(report: Path, width: int, scheme: str) -> None:
    asked: list[str] = []
    with chromium() as browser:
        page = browser.new_context(viewport={"width": width, "height": 844}, color_scheme=scheme).new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.goto(report.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(_CUT) == [], "reasons are read whole"
        assert "-0.0" not in page.inner_text(".events")
        colours = page.evaluate(_COLOURS)
    assert [url for url in asked if not url.startswith("data:")] == [report.as_uri()]
    weak = {(tag, _hex(on), _hex(under)) for tag, on, under in colours}
    assert not [one for one in weak if contrast(one[1], one[2]) < 4.5]
