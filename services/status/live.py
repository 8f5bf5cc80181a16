"""Draws the live page's parts from the state: once for all browsers, and only what has changed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.status.board import Board
from services.status.events import Event
from services.status.parts import (
    fences_part,
    graph_parts,
    local_part,
    plan_part,
    policy_part,
    pose_part,
    raw,
    risk_part,
    tile_part,
)
from services.status.step_times import COLUMNS
from services.status.view import SlowView, View

_TRAIL_CHUNK = 256
_ROWS = 256
_EVENTS = 320
_EVENT_CHUNK = 32
_CURVE = ("elapsed_s", "belief", "judge")


class Painter:
    """Turns views into the parts of a board. Remembers what it has drawn by identity: messages are frozen."""

    def __init__(self) -> None:
        self.board = Board()
        self.pastes = 0
        self._drawn: dict[str, object] = {}

    def _new(self, key: str, source: object) -> bool:
        """Whether this source has not been drawn yet; remembers it."""
        if source is None or self._drawn.get(key) is source:
            return False
        self._drawn[key] = source
        return True

    def paint(self, view: View) -> None:
        """Bring the board up to the view."""
        board = self.board
        if view.odometry is not None and view.place is not None and self._new("pose", view.odometry):
            board.put("pose", pose_part(view.odometry, *view.place))
        if view.risk is not None and self._new("risk", view.risk):
            board.put("risk", risk_part(view.risk))
        if view.local is not None and self._new("local", view.local):
            board.put("local", local_part(view.local))
        if view.plan is not None and self._new("plan", view.plan):
            board.put("plan", plan_part(view.plan, view.old_path))
        self._paint_graph(view)
        self._paint_tiles(view)
        self._paint_trail(view)
        if view.fences is not None and self._new("fences", view.fences):
            board.put("fences", fences_part(view.fences))
        if view.slow is not None:
            self._paint_slow(view.slow)

    def _paint_slow(self, slow: SlowView) -> None:
        more = {"restarts": slow.restarts, "began_s": slow.began_s}
        self.board.put("status", slow.report.model_dump(mode="json") | more)
        curve = [(point.elapsed_s, point.belief, point.judge) for point in slow.curve]
        self._paint_rows("curve", _CURVE, np.array(curve, np.float32).reshape(-1, len(_CURVE)))
        self._paint_rows("steps", COLUMNS, slow.step_times)
        self._paint_events(slow.events)

    def _paint_rows(self, word: str, columns: tuple[str, ...], rows: NDArray[np.float32]) -> None:
        chunks = -(-len(rows) // _ROWS)
        for chunk in range(chunks):
            part = rows[chunk * _ROWS : (chunk + 1) * _ROWS]
            self.board.put(f"{word}:{chunk}", {"columns": list(columns), "rows": raw(part, "f4")})
        self.board.keep_only(f"{word}:", {f"{word}:{n}" for n in range(chunks)})

    def _paint_events(self, events: tuple[Event, ...]) -> None:
        """The newest ones, in chunks by their number."""
        shown = events[-_EVENTS:]
        if not shown or not self._new("events", shown[-1]):
            return
        chunks: dict[int, list[dict[str, object]]] = {}
        for event in shown:
            chunks.setdefault(event.id // _EVENT_CHUNK, []).append(event.model_dump(mode="json"))
        for number, told in chunks.items():
            self.board.put(f"events:{number}", {"events": told})
        self.board.keep_only("events:", {f"events:{number}" for number in chunks})

    def _paint_graph(self, view: View) -> None:
        if self._new("graph", view.graph):
            chunks = graph_parts(view.graph)
            for number, part in chunks.items():
                self.board.put(f"graph:{number}", part)
            self.board.keep_only("graph:", {f"graph:{number}" for number in chunks})
        if view.policy is not None and self._new("policy", view.policy):
            self.board.put("policy", policy_part(view.policy, view.graph))

    def _paint_tiles(self, view: View) -> None:
        self.pastes = view.pastes
        for (tx, ty), cells in view.tiles.items():
            self.board.put(f"cov:{tx}:{ty}", tile_part(view.resolution_m, (tx, ty), cells))
        if view.tiles:
            self.board.keep_only("cov:", {f"cov:{tx}:{ty}" for tx, ty in view.tile_names})

    def _paint_trail(self, view: View) -> None:
        """In chunks: of a long way only the last one changes."""
        count = len(view.trajectory)
        before = self._drawn.get("trail")
        if before == (count, view.trajectory[-1:]):
            return
        first = 0 if not isinstance(before, tuple) or before[0] > count else before[0] // _TRAIL_CHUNK
        self._drawn["trail"] = (count, view.trajectory[-1:])
        for chunk in range(first, -(-count // _TRAIL_CHUNK)):
            points = view.trajectory[chunk * _TRAIL_CHUNK : (chunk + 1) * _TRAIL_CHUNK + 1]
            self.board.put(f"trail:{chunk}", {"xy": raw(np.array(points), "f4")})
        self.board.keep_only("trail:", {f"trail:{n}" for n in range(-(-count // _TRAIL_CHUNK))})
