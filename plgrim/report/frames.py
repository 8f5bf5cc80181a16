"""Moving pictures of a mission as an animated PNG: map, coverage, driven path, road map, frontiers, target, plan."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from planning.frames import Planar, in_map, planar
from planning.graph_mirror import FRONTIER, GraphMirror
from schemas.base import Message, Pose
from schemas.contract import SECOND_NS, Stamp
from schemas.operation import FinishReason, JudgeReport, MissionState, WorldPicture
from schemas.policy import GlobalPolicy, Plan
from schemas.sensing import Odometry
from schemas.world import CoverageWindow, GlobalIrm

_UNKNOWN, _SOLID, _GROUND, _SEEN, _FAR = (
    (246, 247, 249),
    (52, 64, 77),
    (250, 222, 178),
    (166, 214, 190),
    (214, 220, 226),
)
_WINDOW_COLOURS = np.array([_UNKNOWN, _GROUND, _SEEN, _SOLID, _FAR], np.uint8)
_WORLD_GHOST, _WORLD_ROCK = (255, 255, 255), (225, 229, 234)
_PATH, _EDGE, _CRUMB, _EDGE_OF, _TARGET, _PLAN, _INK = (
    (194, 65, 12), (146, 175, 196), (59, 92, 160), (217, 119, 6), (190, 18, 60), (29, 78, 216), (31, 41, 51),
)  # fmt: skip
_LEGEND = ("robot", "driven", "plan", "target", "frontier", "road map", "covered", "to cover", "obstacle")
LEGEND_PX, _LEGEND_FONT = 22, 13
"""Height of the line below the map that says what is what, and its letters'."""
SHOWN = frozenset(
    {
        "sim/world_picture", "irm/coverage_window", "irm/global_irm", "sim/odometry", "gcp/global_policy",
        "reconciler/plan", "sim/judge", "mission/state",
    }
)  # fmt: skip
"""Topics that a frame is made of."""
_SCALE = 2
"""Drawn so many times larger and made smaller at the end: smooth lines."""


def with_few_colours(image: Image.Image) -> Image.Image:
    """The picture in the drawing's colours and their mixtures: a palette of the largest areas would lose the lines."""
    grounds = (_UNKNOWN, _GROUND, _SEEN, _WORLD_GHOST, _WORLD_ROCK, _SOLID, _FAR)
    lines = (_PATH, _EDGE, _CRUMB, _EDGE_OF, _TARGET, _PLAN, _INK)
    mixed = [tuple((a + b) // 2 for a, b in zip(g, c, strict=True)) for g in grounds[:5] for c in lines]
    mixed += [tuple((a + b) // 2 for a, b in zip(_SOLID, g, strict=True)) for g in grounds]
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for colour in (*grounds, *lines, *mixed) for value in colour])
    return image.convert("RGB").quantize(palette=palette, dither=Image.Dither.NONE)


@dataclass(slots=True)
class _Canvas:
    """Pixels over the world. left_m, top_m: its upper left corner in `map`; px_per_m: of the final picture."""

    left_m: float
    top_m: float
    px_per_m: float
    size: tuple[int, int]

    def px(self, xy_m: NDArray[np.float64]) -> list[tuple[float, float]]:
        """Points (n, 2) as pixels of the large picture."""
        k = self.px_per_m * _SCALE
        x, y = (xy_m[:, 0] - self.left_m) * k, (self.top_m - xy_m[:, 1]) * k
        return list(zip(x.tolist(), y.tolist(), strict=True))


@dataclass(slots=True)
class FrameMaker:
    """Takes a mission's messages in, and draws a frame every so often.

    every_s: mission seconds between frames. width_px: of the pictures. The world's picture gives their extent: frames
    begin when the first one has come.
    """

    every_s: float = 5.0
    width_px: int = 720
    frames: list[Image.Image] = field(default_factory=list)
    _canvas: _Canvas | None = None
    _ground: Image.Image | None = None
    _belief: NDArray[np.uint8] | None = None
    _extent: tuple[float, int, int] = (1.0, 0, 0)
    _graph: GraphMirror = field(default_factory=GraphMirror)
    _odometry: Odometry | None = None
    _policy: GlobalPolicy | None = None
    _plan: Plan | None = None
    _judge: JudgeReport | None = None
    _driven: list[tuple[float, float]] = field(default_factory=list)
    _over: bool = False
    _due_ns: Stamp = 0
    _first_ns: Stamp = -1

    def observe(self, message: Message, now: Stamp) -> None:
        """Take in a message. now: mission clock, ns."""
        match message:
            case WorldPicture() if self._canvas is None:
                self._begin(message)
            case CoverageWindow():
                self._take_window(message)
            case GlobalIrm():
                self._graph.apply(message)
            case Odometry():
                self._odometry = message
                self._drive(message)
            case GlobalPolicy():
                self._policy = message
            case Plan():
                self._plan = message
            case JudgeReport():
                self._judge = message
            case MissionState():
                self._over = message.finish is not FinishReason.NONE
        if self._canvas is not None and self._odometry is not None and now >= self._due_ns:
            self._first_ns = now if self._first_ns < 0 else self._first_ns
            self._due_ns = now + int(self.every_s * SECOND_NS)
            self.frames.append(self.draw(now))

    def _begin(self, world: WorldPicture) -> None:
        r, (rows, columns) = world.resolution_m, world.cell.shape
        px_per_m = self.width_px / (columns * r)
        size = (self.width_px, max(1, round(rows * r * px_per_m)))
        self._canvas = _Canvas(world.ix0 * r, (world.iy0 + rows) * r, px_per_m, size)
        colours = np.array([_WORLD_ROCK, _WORLD_GHOST, _WORLD_GHOST, _WORLD_GHOST], np.uint8)
        self._ground = Image.fromarray(colours[world.cell[::-1]])
        self._extent = (r, world.ix0, world.iy0)
        self._belief = np.zeros(world.cell.shape, np.uint8)

    def _take_window(self, window: CoverageWindow) -> None:
        """Lay what the robot believes around it over what it believed before, on the cells of the world's picture."""
        if self._belief is None:
            return
        r, ix0, iy0 = self._extent
        g = window.grid
        rows, columns = self._belief.shape
        iy = np.floor(((np.arange(rows) + iy0 + 0.5) * r) / g.resolution_m).astype(int) - g.iy0
        ix = np.floor(((np.arange(columns) + ix0 + 0.5) * r) / g.resolution_m).astype(int) - g.ix0
        row, column = (iy >= 0) & (iy < g.height), (ix >= 0) & (ix < g.width)
        new = window.cell[np.ix_(iy[row], ix[column])]
        place = np.ix_(row, column)
        old = self._belief[place]
        self._belief[place] = np.where(new > 0, new, old)

    def _drive(self, odometry: Odometry) -> None:
        x, y, _ = in_map(odometry.map_to_odom, odometry.pose)
        if not self._driven or abs(x - self._driven[-1][0]) + abs(y - self._driven[-1][1]) > 0.3:
            self._driven.append((x, y))

    def draw(self, now: Stamp) -> Image.Image:
        """The picture of this moment."""
        assert self._canvas is not None and self._ground is not None and self._belief is not None
        canvas = self._canvas
        large = (canvas.size[0] * _SCALE, canvas.size[1] * _SCALE)
        ground = np.asarray(self._ground).copy()
        known = self._belief[::-1]
        ground[known > 0] = _WINDOW_COLOURS[known[known > 0]]
        image = Image.fromarray(ground).resize(large, Image.Resampling.NEAREST)
        pen = ImageDraw.Draw(image)
        self._draw_graph(pen, canvas)
        if len(self._driven) > 1:
            pen.line(canvas.px(np.array(self._driven)), fill=_PATH, width=3 * _SCALE, joint="curve")
        self._draw_plan(pen, canvas)
        self._draw_robot(pen, canvas)
        width, height = canvas.size
        picture = Image.new("RGB", (width, height + LEGEND_PX), _WORLD_GHOST)
        picture.paste(image.resize(canvas.size, Image.Resampling.LANCZOS))
        picture.paste(_legend(width), (0, height))
        self._write(ImageDraw.Draw(picture), now)
        return picture

    def _draw_graph(self, pen: ImageDraw.ImageDraw, canvas: _Canvas) -> None:
        graph = self._graph.road_map()
        if graph.node_id.size == 0:
            return
        places = canvas.px(graph.xyz_m[:, :2])
        for a in range(graph.node_id.size):
            for b in graph.indices[graph.indptr[a] : graph.indptr[a + 1]].tolist():
                if a < b and graph.kind[a] != FRONTIER and graph.kind[b] != FRONTIER:
                    pen.line([places[a], places[b]], fill=_EDGE, width=_SCALE)
        for (x, y), kind in zip(places, graph.kind.tolist(), strict=True):
            if kind == FRONTIER:
                _diamond(pen, x, y)
            else:
                d = 1.6 * _SCALE
                pen.ellipse([x - d, y - d, x + d, y + d], fill=_CRUMB)

    def _draw_plan(self, pen: ImageDraw.ImageDraw, canvas: _Canvas) -> None:
        policy, plan, odometry = self._policy, self._plan, self._odometry
        if self._over:
            return
        if policy is not None and policy.target >= 0:
            _ring(pen, *canvas.px(np.array([policy.target_xyz_m[:2]]))[0])
        if plan is not None and plan.valid and odometry is not None and len(plan.x_m) > 1:
            frame = odometry.map_to_odom
            points = [
                _compose(frame, x, y) for x, y in zip(plan.x_m.tolist(), plan.y_m.tolist(), strict=True)
            ]
            pen.line(canvas.px(np.array(points)), fill=_PLAN, width=2 * _SCALE, joint="curve")

    def _draw_robot(self, pen: ImageDraw.ImageDraw, canvas: _Canvas) -> None:
        if self._odometry is None:
            return
        x, y, yaw = in_map(self._odometry.map_to_odom, self._odometry.pose)
        _arrow(pen, *canvas.px(np.array([[x, y]]))[0], yaw)

    def _write(self, pen: ImageDraw.ImageDraw, now: Stamp) -> None:
        text = f"{(now - max(0, self._first_ns)) / SECOND_NS:.0f} s"
        if self._judge is not None:
            text += f"   {100 * self._judge.coverage:.0f} % covered   {self._judge.distance_m:.0f} m driven"
        pen.rectangle([6, 6, 14 + pen.textlength(text, font_size=15), 28], fill=(255, 255, 255))
        pen.text((10, 8), text, fill=_INK, font_size=15)

    def save(self, path: Path, frame_ms: int = 120, most_frames: int = 120) -> int:
        """Write an animated PNG (.png) or GIF (.gif); its size in bytes. ValueError when there is no frame."""
        if not self.frames:
            raise ValueError("no frame: the recording holds no world picture, or nothing was driven")
        every = max(1, -(-len(self.frames) // most_frames))
        chosen = [*self.frames[:-1:every], self.frames[-1]]
        few = [with_few_colours(frame) for frame in chosen]
        times = [frame_ms] * (len(few) - 1) + [2500]
        path.parent.mkdir(parents=True, exist_ok=True)
        options: dict[str, Any] = {"optimize": True} if path.suffix == ".gif" else {"default_image": False}
        few[0].save(path, save_all=True, append_images=few[1:], duration=times, loop=0, **options)
        return path.stat().st_size


def _compose(frame: Pose, x: float, y: float) -> tuple[float, float]:
    at = planar(frame).compose(Planar(x, y, 0.0))
    return at.x_m, at.y_m


def _diamond(pen: ImageDraw.ImageDraw, x: float, y: float) -> None:
    """A frontier: told apart by shape, not by colour alone."""
    d = 4.5 * _SCALE
    pen.polygon([(x - d, y), (x, y - d), (x + d, y), (x, y + d)], fill=_EDGE_OF, outline=(255, 255, 255))


def _ring(pen: ImageDraw.ImageDraw, x: float, y: float) -> None:
    """The target."""
    d = 8 * _SCALE
    pen.ellipse([x - d, y - d, x + d, y + d], outline=_TARGET, width=2 * _SCALE)


def _arrow(pen: ImageDraw.ImageDraw, x: float, y: float, yaw: float) -> None:
    """The robot, with a white rim wide enough to be found on anything."""
    for d, colour in ((11.0 * _SCALE, (255, 255, 255)), (8.0 * _SCALE, _INK)):
        turned = [yaw, yaw + 2.5, yaw + np.pi, yaw - 2.5]
        reach = [d, d, 0.35 * d, d]
        points = [(x + r * np.cos(a), y - r * np.sin(a)) for a, r in zip(turned, reach, strict=True)]
        pen.polygon(points, fill=colour)


@cache
def _legend(width: int) -> Image.Image:
    """What is what, in a line; from the left as far as it fits."""
    large = Image.new("RGB", (width * _SCALE, LEGEND_PX * _SCALE), _WORLD_GHOST)
    pen, x, y = ImageDraw.Draw(large), 12.0 * _SCALE, LEGEND_PX * _SCALE / 2
    size = _LEGEND_FONT * _SCALE
    for word in _LEGEND:
        wide = pen.textlength(word, font_size=size)
        if x + 12 * _SCALE + wide > width * _SCALE:
            break
        _sign(pen, word, x, y)
        pen.text((x + 12 * _SCALE, y), word, fill=_INK, font_size=size, anchor="lm")
        x += wide + 33 * _SCALE
    return large.resize((width, LEGEND_PX), Image.Resampling.LANCZOS)


def _sign(pen: ImageDraw.ImageDraw, word: str, x: float, y: float) -> None:
    """A word's sign of the legend, its middle at a pixel of the large picture."""
    d = 6 * _SCALE
    lines = {"driven": (_PATH, 3), "plan": (_PLAN, 2), "road map": (_EDGE, 1)}
    areas = {"covered": _SEEN, "to cover": _GROUND, "obstacle": _SOLID}
    if word in lines:
        pen.line([x - d, y, x + d, y], fill=lines[word][0], width=lines[word][1] * _SCALE)
    elif word in areas:
        pen.rectangle([x - d, y - d, x + d, y + d], fill=areas[word])
    elif word == "target":
        _ring(pen, x, y)
    elif word == "frontier":
        _diamond(pen, x, y)
    else:
        _arrow(pen, x, y, 0.0)
