"""The live page in a real browser, over a status that is fed with a moving scene."""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from planning.frames import planar
from schemas.base import Pose
from schemas.fences import Fence, FenceFrame, FenceKind, Fences, Ring
from schemas.operation import CommandAnswer, CommandKind, MissionCommand, MissionPhase
from services.status.app import SharedStatus, StatusServer
from services.status.config import Config
from tests.status.browser import chromium, until
from tests.status.scene import Scene, mission, odometry

pytestmark = pytest.mark.slow

TOKEN = "operator-token-for-the-tests"
PHASES = {
    CommandKind.START: MissionPhase.EXPLORE,
    CommandKind.PAUSE: MissionPhase.PAUSED,
    CommandKind.RESUME: MissionPhase.EXPLORE,
    CommandKind.HOME: MissionPhase.RETURN,
    CommandKind.STOP: MissionPhase.STOPPED,
}


class Robot:
    """A status service that can be restarted, a scene that moves, and a mission that obeys."""

    def __init__(self, tokens: Path) -> None:
        self.tokens = str(tokens)
        self.asked: list[MissionCommand] = []
        self.fences: list[Fence] = []
        self.moving = True
        self.only_pose = False
        self.port = 0
        self._stop = threading.Event()
        self.begin()
        self._thread = threading.Thread(target=self._move, daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Start the service anew: nothing is left of the one before but its port."""
        self.shared = SharedStatus(Config(port=self.port, tokens_file=self.tokens), "husky1")
        self.shared.desk.send = self._obey
        self.scene = Scene(self.shared, risk_cells=400)
        for _ in range(20):
            self.scene.step()
        self.server = StatusServer(self.shared)
        self.server.start()
        self.port = self.server.port

    def end(self) -> None:
        self._stop.set()
        self._thread.join()
        self.server.stop()

    def _move(self) -> None:
        while not self._stop.wait(0.1):
            if self.only_pose:
                self.shared.observe("sim/odometry", odometry(self.scene.n))
            elif self.moving:
                self.scene.step()

    def _obey(self, command: MissionCommand) -> None:
        self.asked.append(command)
        self.fences += command.fences
        if command.kind == CommandKind.UNFENCE:
            self.fences = [f for f in self.fences if f.fence_id not in command.fence_ids]
        self.fences = [
            f.model_copy(update={"fence_id": f.fence_id or f"f{n}"}) for n, f in enumerate(self.fences)
        ]
        phase = PHASES.get(command.kind, MissionPhase.EXPLORE)
        self.scene.phase = phase
        self.shared.observe("mission/fences", Fences(stamp_ns=1, version=len(self.asked), fences=self.fences))
        self.shared.observe("mission/state", mission(self.scene.n, phase))
        answer = CommandAnswer(
            stamp_ns=1, command_id=command.command_id, kind=command.kind, accepted=True,
            reason=f"did {command.kind.value}", phase=phase, fence_ids=[], fences_version=len(self.asked),
        )  # fmt: skip
        self.shared.observe("mission/answer", answer)


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    tokens = tmp_path / "tokens"
    tokens.write_text(f"operator test {TOKEN}\n", encoding="utf-8")
    tokens.chmod(0o600)
    robot = Robot(tokens)
    yield robot
    robot.end()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture
def open_page(robot: Robot, browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens pages, and afterwards checks that none complained or asked another host."""
    wrong: list[str] = []
    contexts: list[Any] = []

    def note(request: Any) -> None:
        if not request.url.startswith((f"http://127.0.0.1:{robot.port}/", "data:", "blob:")):
            wrong.append(f"asked {request.url}")

    def opened(width: int = 1280, height: int = 800, quiet: bool = True, **options: Any) -> Any:
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("request", note)
        if quiet:
            page.on("console", lambda m: wrong.append(m.text) if m.type in ("error", "warning") else None)
            page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(f"http://127.0.0.1:{robot.port}/")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert not wrong


MAP_SHOWN = "(plgrim.map?.firstMapAt ?? 0) > 0"


def test_shows_the_map_within_two_seconds_of_opening(open_page: Callable[..., Any]) -> None:
    page = open_page()
    until(page, MAP_SHOWN)
    shown_ms = page.evaluate("plgrim.map.firstMapAt")  # since the navigation began
    print(f"\nmap shown {shown_ms:.0f} ms after opening")
    assert shown_ms < 2000
    colours = page.evaluate("""(() => {
      const copy = document.createElement("canvas"), map = plgrim.map.canvas;
      Object.assign(copy, { width: map.width, height: map.height });
      const context = copy.getContext("2d", { willReadFrequently: true });
      context.drawImage(map, 0, 0);
      return new Set(new Uint32Array(context.getImageData(0, 0, map.width, map.height).data.buffer)).size;
    })()""")
    assert colours > 20, "a map has many colours"


def test_updates_at_five_hertz_with_two_browsers_open(open_page: Callable[..., Any]) -> None:
    pages = [open_page(), open_page()]
    for page in pages:
        until(page, MAP_SHOWN)
    count = "({frames: plgrim.link.frames, drawn: plgrim.map.drawn, at: performance.now()})"
    before = [page.evaluate(count) for page in pages]
    pages[0].wait_for_timeout(5000)
    after = [page.evaluate(count) for page in pages]
    for a, b in zip(before, after, strict=True):
        seconds = (b["at"] - a["at"]) / 1000
        frames_hz, drawn_hz = (b["frames"] - a["frames"]) / seconds, (b["drawn"] - a["drawn"]) / seconds
        print(f"\n{frames_hz:.1f} frames a second received, {drawn_hz:.1f} drawn")
        assert frames_hz >= 5
        assert drawn_hz >= 5


def test_draws_a_large_map_in_under_ten_milliseconds(open_page: Callable[..., Any]) -> None:
    page = open_page(quiet=False)  # that it is read back so often is a warning
    until(page, MAP_SHOWN)
    risk, nodes = page.evaluate("[plgrim.store.get('risk').cells.length, plgrim.store.graph().x.length]")
    assert risk == 400 * 400
    assert nodes >= 5000
    page.evaluate("plgrim.map.fit()")
    # Every frame drawn anew, whole, from another place, and read back so that it is finished.
    times = page.evaluate("plgrim.map.measure(120)")
    median = statistics.median(times)
    print(f"\nframe of 400 x 400 cells and {nodes} nodes: median {median:.1f} ms, worst {max(times):.1f} ms")
    assert median < 10


def test_a_restart_of_the_service_is_shown_and_survived(open_page: Callable[..., Any], robot: Robot) -> None:
    page = open_page(quiet=False)  # the browser itself complains of the refused connections
    until(page, MAP_SHOWN)
    keys = "[...plgrim.store.parts.keys()].map((k) => k.split(':')[0]).sort().join()"
    before, boot = set(page.evaluate(keys).split(",")), page.evaluate("plgrim.link.boot")
    robot.server.stop()
    until(page, "document.querySelector('#bar').textContent.includes('LINK LOST')")
    assert page.evaluate("document.querySelector('.mapbox').classList.contains('lost')")
    assert page.title().startswith("✕ link lost")
    assert page.locator("#command-pause").is_disabled()
    robot.begin()
    waited = until(page, "!plgrim.link.lost")
    print(f"\nlinked again {waited:.1f} s after the service's return")
    until(page, "document.querySelector('#bar').textContent.includes('Linked')")
    assert page.evaluate("plgrim.link.boot") != boot
    assert set(page.evaluate(keys).split(",")) >= before - {"fences"}


def test_a_page_that_was_away_is_told_only_what_changed(open_page: Callable[..., Any]) -> None:
    page = open_page()
    until(page, MAP_SHOWN)
    page.evaluate("""(() => {
      const take = plgrim.store.take.bind(plgrim.store);
      window.taken = [];
      plgrim.store.take = (parts, full) => { window.taken.push([full, Object.keys(parts)]); take(parts, full); };
      plgrim.link.reconnect();
    })()""")
    until(page, "window.taken.length > 0")
    full, keys = page.evaluate("window.taken[0]")
    assert not full
    assert "cov:0:0" not in keys


def test_a_stale_topic_looks_stale(open_page: Callable[..., Any], robot: Robot) -> None:
    page = open_page()
    until(page, MAP_SHOWN)
    robot.only_pose = True
    until(page, "document.querySelectorAll('.layers .late').length >= 3")
    until(page, "document.querySelector('#bar').classList.contains('warn')")
    until(page, "document.querySelectorAll('tr[data-state=silent]').length >= 5")
    assert " Hz" not in page.inner_text("tr[data-state=silent]"), "a rate of then is no rate of now"
    assert not page.evaluate("plgrim.link.lost"), "the link itself is well"
    assert not page.locator(".lostmark").count(), "the robot still speaks"


def test_a_robot_that_is_not_heard_any_more_is_unmistakable(
    open_page: Callable[..., Any], robot: Robot
) -> None:
    """As at the base when the radio is gone: its own status service and planners go on."""
    page = open_page()
    until(page, MAP_SHOWN)
    robot.moving = False
    until(page, "document.querySelector('.lostmark')?.textContent === 'ROBOT SILENT'")
    assert "Nothing has come from it for" in page.inner_text("#bar")
    assert page.evaluate("document.querySelector('#bar').classList.contains('bad')")
    assert page.evaluate("document.querySelector('.mapbox').classList.contains('lost')")
    assert page.title().startswith("✕ robot silent")
    assert page.locator("#command-stop").is_enabled(), "it may still get through"
    robot.moving = True
    until(page, "!document.querySelector('.lostmark')")


def test_the_end_of_a_mission_is_not_called_a_lost_link(open_page: Callable[..., Any], robot: Robot) -> None:
    """`plgrim demo` ends its services with the mission."""
    page = open_page(quiet=False)
    until(page, MAP_SHOWN)
    robot.scene.phase = MissionPhase.DONE
    until(page, "plgrim.store.get('status').mission.phase === 'done'")
    robot.server.stop()
    until(page, "document.querySelector('.lostmark')?.textContent === 'MISSION OVER'")
    assert "what you see is" in page.inner_text("#bar")
    assert "LINK LOST" not in page.inner_text("body")


def test_a_choice_of_layers_is_kept_and_a_broken_one_does_no_harm(open_page: Callable[..., Any]) -> None:
    page = open_page()
    until(page, MAP_SHOWN)
    page.click("#layer-risk")
    page.reload()
    until(page, MAP_SHOWN)
    assert not page.is_checked("#layer-risk")
    page.evaluate("localStorage.setItem('plgrim.layers', '{broken')")
    page.reload()
    until(page, MAP_SHOWN)
    assert page.is_checked("#layer-risk")


@pytest.mark.parametrize("command", ["pause", "home"])
def test_a_command_asks_for_the_token_once_and_is_obeyed(
    open_page: Callable[..., Any], robot: Robot, command: str
) -> None:
    page = open_page(quiet=False)  # a 401 is a line in the console
    until(page, MAP_SHOWN)
    page.click(f"#command-{command}")
    page.fill("#token", TOKEN)
    page.click("#token-give")
    until(page, f"document.querySelector('#answer').textContent.includes('did {command}')")
    until(page, f"plgrim.store.get('status').mission.phase === '{PHASES[CommandKind(command)].value}'")
    page.fill("#budget-minutes", "12.5")
    page.click("#set-budget")
    until(page, "document.querySelector('#answer').textContent.includes('did budget')")
    assert robot.asked[-1].time_budget_s == 750
    assert page.evaluate("Object.keys(sessionStorage).length") == 0


def test_stop_asks_before_it_is_sent(open_page: Callable[..., Any], robot: Robot) -> None:
    page = open_page(quiet=False)
    until(page, MAP_SHOWN)
    page.click("#command-stop")
    assert not robot.asked
    page.click("#command-stop-sure")
    page.fill("#token", TOKEN)
    page.keyboard.press("Enter")
    until(page, "document.querySelector('#answer').textContent.includes('did stop')")
    assert [command.kind for command in robot.asked] == [CommandKind.STOP]


def test_a_polygon_is_drawn_sent_shown_and_removed(open_page: Callable[..., Any], robot: Robot) -> None:
    page = open_page(quiet=False)
    until(page, MAP_SHOWN)
    page.click("#follow")
    page.click("#draw-no_go")
    box = page.locator("#map").bounding_box()
    corners = [(0.3, 0.5), (0.5, 0.5), (0.5, 0.8), (0.3, 0.8)]
    places = []
    for fx, fy in corners:
        x, y = fx * box["width"], fy * box["height"]
        places.append(page.evaluate(f"plgrim.map.world({x}, {y})"))
        page.mouse.click(box["x"] + x, box["y"] + y)
    page.click("#draw-finish")
    page.fill("#token", TOKEN)
    page.click("#token-give")
    until(page, "document.querySelectorAll('.fences li').length === 1")
    ring = robot.fences[0].rings[0].points
    assert robot.fences[0].kind == "no_go"
    assert robot.fences[0].frame == "map"
    assert ring[0] == ring[-1]
    for (x, y), (px, py) in zip(ring, places, strict=False):
        assert (x, y) == pytest.approx((px, py), abs=0.2)
    assert page.evaluate("plgrim.map.fences.length") == 1
    page.click(".fences button")
    until(page, "document.querySelectorAll('.fences li').length === 0")


def _sides_drawn(page: Any, corners: list[tuple[float, float]], colour: str) -> int:
    """On how many sides of a polygon, places in `map`, the middle is drawn in a colour, within a pixel."""
    sides = zip(corners, [*corners[1:], corners[0]], strict=True)
    middles = [[(a[0] + b[0]) / 2, (a[1] + b[1]) / 2] for a, b in sides]
    count: int = page.evaluate(
        """([places, name]) => {
          const map = plgrim.map;
          map.follow = false;
          map.shown = { fences: true };
          [map.cx, map.cy, map.scale] = [5, 0, 12];
          map.draw();
          const copy = document.createElement("canvas");
          Object.assign(copy, { width: map.canvas.width, height: map.canvas.height });
          const context = copy.getContext("2d", { willReadFrequently: true });
          context.drawImage(map.canvas, 0, 0);
          const hex = map.colours[name].replace("#", "");
          const wanted = [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16));
          const here = ([x, y]) => {
            const data = context.getImageData(Math.floor(x) - 1, Math.floor(y) - 1, 3, 3).data;
            for (let i = 0; i < data.length; i += 4) if (wanted.every((v, k) => data[i + k] === v)) return true;
            return false;
          };
          return places.map(([x, y]) => map.screen(x, y).map((at) => at * map.ratio)).filter(here).length;
        }""",
        [middles, colour],
    )
    return count


def _placed(frame: Pose, corners: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The corners, of `odom`, in `map`."""
    return [planar(frame).apply(x, y) for x, y in corners]


@pytest.mark.parametrize("kind", [FenceKind.GEOFENCE, FenceKind.NO_GO])
def test_polygons_are_drawn_where_they_lie_in_their_own_frame_also_after_a_loop_closure(
    open_page: Callable[..., Any], robot: Robot, kind: FenceKind
) -> None:
    corners = [(2.0, 1.0), (9.0, 1.0), (9.0, 7.0), (2.0, 7.0)]
    ring = Ring.of([*corners, corners[0]])
    page = open_page(quiet=False)
    until(page, MAP_SHOWN)
    robot.moving = False
    page.wait_for_timeout(300)
    colour = "geofence" if kind == FenceKind.GEOFENCE else "noGo"
    for version, frame in enumerate(FenceFrame):
        drawn = Fence(fence_id="one", kind=kind, frame=frame, rings=[ring])
        robot.shared.observe("mission/fences", Fences(stamp_ns=1, version=version + 1, fences=[drawn]))
        until(page, f"plgrim.map.fences[0]?.frame === '{frame.value}'")
        for map_to_odom in (Pose(x_m=4.0, y_m=-9.0, yaw_rad=0.7), Pose(x_m=-3.0, y_m=2.0, yaw_rad=-0.4)):
            moved = odometry(robot.scene.n).model_copy(update={"map_to_odom": map_to_odom})
            robot.shared.observe("sim/odometry", moved)
            until(page, f"Math.abs(plgrim.store.get('pose').frame[2] - {map_to_odom.yaw_rad}) < 1e-6")
            here = corners if frame == FenceFrame.MAP else _placed(map_to_odom, corners)
            elsewhere = corners if frame == FenceFrame.ODOM else _placed(map_to_odom, corners)
            least = 4 if kind == FenceKind.GEOFENCE else 1  # a dashed line has gaps
            assert _sides_drawn(page, here, colour) >= least, f"{frame}: not where it lies"
            assert _sides_drawn(page, elsewhere, colour) <= 1, f"{frame}: as if it lay in the other frame"


def test_a_polygon_can_be_drawn_with_the_keyboard_alone(open_page: Callable[..., Any], robot: Robot) -> None:
    page = open_page(quiet=False)
    until(page, MAP_SHOWN)
    until(page, "!document.querySelector('#draw-priority').disabled")
    page.focus("#draw-priority")
    page.keyboard.press("Enter")
    for key in ("Space", "ArrowRight", "ArrowRight", "Space", "ArrowDown", "ArrowDown", "Space", "Enter"):
        page.keyboard.press(key)
    until(page, "document.querySelector('dialog').open")
    page.keyboard.type(TOKEN)
    page.keyboard.press("Enter")
    until(page, "document.querySelectorAll('.fences li').length === 1")
    assert robot.fences[0].kind == "priority"
    assert len(robot.fences[0].rings[0].points) == 4


def test_every_control_is_reached_by_the_tab_key_and_named(open_page: Callable[..., Any]) -> None:
    page = open_page()
    until(page, MAP_SHOWN)
    until(page, "!document.querySelector('#command-pause').disabled")
    reached = []
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate("""(() => {
              const e = document.activeElement, style = getComputedStyle(e);
              const name = e.getAttribute("aria-label") || e.labels?.[0]?.textContent.trim() || e.textContent.trim();
              return [e.id || e.tagName, name, e === document.body || parseFloat(style.outlineWidth) >= 2];
            })()""")
        )
        if reached[-1][0] == "BODY":
            break
    ids = [name for name, _, _ in reached]
    wanted = ["map", "zoom-in", "follow", "layer-coverage", "command-pause", "command-home", "command-stop",
              "budget-minutes", "set-budget", "draw-geofence", "draw-no_go", "draw-priority"]  # fmt: skip
    assert [name for name in ids if name in wanted] == wanted, "all, in the order of reading"
    assert not [name for name, said, _ in reached if not said and name != "BODY"], "each has a name"
    assert not [name for name, _, seen in reached if not seen], "the focus is seen"


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_nothing_is_wider_than_the_window(open_page: Callable[..., Any], width: int, height: int) -> None:
    page = open_page(width, height)
    until(page, MAP_SHOWN)
    page.wait_for_timeout(700)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    small = page.evaluate("""[...document.querySelectorAll("button")].filter((b) => b.offsetParent
      && (b.offsetHeight < 24 || b.offsetWidth < 24)).map((b) => b.textContent)""")
    assert not small, "targets of 24 px at least (WCAG 2.2)"


def test_the_read_out_names_frame_place_risk_and_coverage(open_page: Callable[..., Any]) -> None:
    page = open_page()
    until(page, MAP_SHOWN)
    page.click("#follow")
    page.evaluate("(plgrim.map.cx = 0, plgrim.map.cy = 0)")
    box = page.locator("#map").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2 + 12, box["y"] + box["height"] / 2 - 24)
    time.sleep(0.3)
    text = page.locator("#readout").inner_text().replace("\n", " ")
    assert text.startswith("map x 1.00 y 2.00 m risk")
    assert text.endswith(("covered", "obstacle"))
