"""What the live page tells of the past and no message tells again: the old path, restarts, step times."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from schemas.base import Message
from schemas.operation import MissionState, StageHealth
from schemas.policy import Plan
from services.status.parts import path_xy
from services.status.step_times import StepTimes
from services.status.view import NO_POINTS

_NEW_END_M = 0.75


class LiveMemory:
    """Fed with every message.

    old_path: (m, 2) in `odom`, the path that the newest policy replaced. restarts: of each service, as told by its
    process id.
    """

    def __init__(self) -> None:
        self.old_path = NO_POINTS
        self.restarts: Counter[str] = Counter()
        self.step_times = StepTimes()
        self._plan: Plan | None = None
        self._pids: dict[str, int] = {}
        self._step_ms: dict[str, float] = {}

    def observe(self, message: Message) -> None:
        """Take in one message."""
        match message:
            case Plan():
                self._see_plan(message)
            case StageHealth():
                self._see_health(message)
            case MissionState() if self.step_times.due(message.elapsed_s):
                self.step_times.add(message.elapsed_s, self._step_ms)

    def _see_plan(self, plan: Plan) -> None:
        """A policy is another one when its end does not lie on the path that was driven so far."""
        if not plan.valid:
            return
        last, self._plan = self._plan, plan
        if last is None:
            return
        gaps = np.hypot(last.x_m - plan.x_m[-1], last.y_m - plan.y_m[-1])
        if float(gaps.min()) > _NEW_END_M:
            self.old_path = path_xy(last)

    def _see_health(self, health: StageHealth) -> None:
        if self._pids.get(health.service, health.pid) != health.pid:
            self.restarts[health.service] += 1
        self._pids[health.service] = health.pid
        self._step_ms[health.service] = health.step_p50_ms

    def state(self) -> dict[str, Any]:
        """For a snapshot."""
        return {
            "step_times": self.step_times.state(),
            "restarts": dict(self.restarts),
            "pids": dict(self._pids),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """From a snapshot."""
        self.step_times.set_state(state["step_times"])
        self.restarts = Counter(state["restarts"])
        self._pids = dict(state["pids"])
