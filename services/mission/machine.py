"""The mission's state machine: pure, stepped with facts, one owner of phase, budget and finish reason.

IDLE -> EXPLORE <-> PAUSED <-> RETURN -> DONE;  EXPLORE -> DONE;  anything but DONE -> STOPPED
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

from schemas.contract import SECOND_NS
from schemas.operation import CommandKind, FinishReason, MissionPhase
from services.mission.config import Config

_OVER = (MissionPhase.DONE, MissionPhase.STOPPED)
_REMEMBERED_COMMANDS = 256
_REBASE_M2 = 20.0
"""A fall of the covered area by more than this is ground that was cut off, not noise, ..."""
_MOST_REBASES = 3
"""... so many times in a row."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What a step of the machine is told.

    now_ns: mission clock. localised: odometry has come. distance_m: driven since the first odometry.
    return_distance_m: travel home by the graph. home_distance_m: straight line home. settled: nothing left to
    go to that is worth the way (None: not known now). covered_area_m2: by the belief (None: not known now). left:
    places left uncovered. commands: (id, kind), oldest first.
    """

    now_ns: int
    localised: bool = False
    distance_m: float = 0.0
    return_distance_m: float = 0.0
    home_distance_m: float = math.inf
    settled: bool | None = None
    covered_area_m2: float | None = None
    left: int = 0
    commands: tuple[tuple[str, CommandKind], ...] = ()


class Outcome(NamedTuple):
    """What became of a command, in plain words."""

    accepted: bool
    reason: str


@dataclass(slots=True)
class Machine:
    """Phase, finish reason and the timers behind them; all times in mission-clock ns, -1 for not yet.

    paused_phase: the phase to resume. pending: why the robot is on its way home. start_m: distance at the
    start. time_budget_s: the configured one, or the operator's; 0: none.
    """

    config: Config
    phase: MissionPhase = MissionPhase.IDLE
    finish: FinishReason = FinishReason.NONE
    reason: str = "waiting for odometry"
    paused_phase: MissionPhase = MissionPhase.EXPLORE
    pending: FinishReason = FinishReason.NONE
    started_ns: int = -1
    finished_ns: int = -1
    start_m: float = 0.0
    settled_since_ns: int = -1
    last_step_ns: int = -1
    idle_ns: int = 0
    best_area_m2: float = 0.0
    peak_area_m2: float = 0.0
    rebased: int = 0
    best_return_m: float = math.inf
    time_budget_s: float = -1.0
    seen: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.time_budget_s < 0:
            self.time_budget_s = self.config.time_budget_s

    def step(self, facts: Facts) -> None:
        """Take in the facts and move on.

        Commands first, then the way home, then what ends the exploration.
        """
        for command_id, kind in facts.commands:
            self.command(command_id, kind, facts)
        if self.phase == MissionPhase.IDLE:
            self._idle(facts)
        if self.phase == MissionPhase.RETURN:
            self._return(facts)
        elif self.phase == MissionPhase.EXPLORE:
            self._explore(facts)
        self.last_step_ns = facts.now_ns

    def elapsed_s(self, now_ns: int) -> float:
        """Mission time since the start, pauses included; it stands still when the mission is over."""
        if self.started_ns < 0:
            return 0.0
        end_ns = self.finished_ns if self.finished_ns >= 0 else now_ns
        return (end_ns - self.started_ns) / SECOND_NS

    def command(self, command_id: str, kind: CommandKind, facts: Facts) -> Outcome:
        """Carry out a command once; one that does not fit the phase changes nothing, and says why."""
        if command_id in self.seen:
            return Outcome(False, "carried out before")
        self.seen = [*self.seen, command_id][-_REMEMBERED_COMMANDS:]
        if self.phase in _OVER:
            return Outcome(False, f"the mission is over ({self.finish.value})")
        before = self.phase
        if kind == CommandKind.STOP:
            self._end(MissionPhase.STOPPED, FinishReason.STOPPED, "stopped by the operator", facts)
        elif kind == CommandKind.START:
            return self._start_asked(facts)
        elif kind == CommandKind.PAUSE:
            if self.phase not in (MissionPhase.EXPLORE, MissionPhase.RETURN):
                return Outcome(False, f"nothing to pause: the mission is {before.value}")
            self.paused_phase, self.phase = self.phase, MissionPhase.PAUSED
            self.reason = "paused by the operator"
        elif kind == CommandKind.RESUME:
            if self.phase != MissionPhase.PAUSED:
                return Outcome(False, f"nothing to resume: the mission is {before.value}")
            self._resume(facts)
        elif kind == CommandKind.HOME:
            return self._home(facts)
        return Outcome(True, f"{self.reason}; {self.phase.value} after {before.value}")

    def _start_asked(self, facts: Facts) -> Outcome:
        if self.phase != MissionPhase.IDLE:
            return Outcome(False, f"started already: the mission is {self.phase.value}")
        if not facts.localised:
            return Outcome(False, "cannot start: there is no odometry yet")
        self._start(facts, "started by the operator")
        return Outcome(True, self.reason)

    def _home(self, facts: Facts) -> Outcome:
        """Go home; a robot that is on its way already keeps the reason for which it turned back."""
        if self.phase == MissionPhase.PAUSED and self.paused_phase == MissionPhase.RETURN:
            self._resume(facts)
            return Outcome(True, "goes on its way home")
        if self.phase == MissionPhase.RETURN:
            return Outcome(True, f"on its way home already: {self.reason}")
        if self.phase not in (MissionPhase.EXPLORE, MissionPhase.PAUSED):
            return Outcome(False, f"not under way: the mission is {self.phase.value}")
        self._go_home(FinishReason.RETURNED, "sent home by the operator", facts)
        return Outcome(True, f"{self.reason}, {facts.return_distance_m:.0f} m")

    def set_time_budget(self, time_budget_s: float, facts: Facts) -> Outcome:
        """Another time budget, counted from the start (0: none). With more of it a robot that turned back for its time
        goes on exploring; the next step turns it back again when it does not suffice."""
        if self.phase in _OVER:
            return Outcome(False, f"the mission is over ({self.finish.value})")
        before, self.time_budget_s = self.time_budget_s, time_budget_s
        was = f"{before:g} s" if before else "none"
        now = f"{time_budget_s:g} s" if time_budget_s else "none"
        text = f"time budget {now} (was {was}), {self.elapsed_s(facts.now_ns):.0f} s are spent"
        more = time_budget_s == 0 or 0 < before < time_budget_s
        if (
            more
            and self.pending == FinishReason.TIME_BUDGET
            and MissionPhase.RETURN in (self.phase, self._held())
        ):
            self.pending = FinishReason.NONE
            if self.phase == MissionPhase.PAUSED:
                self.paused_phase = MissionPhase.EXPLORE
            else:
                self.phase, self.reason = MissionPhase.EXPLORE, "the time budget was raised"
                self.idle_ns = 0
                self._restart_timers(facts)
            text += "; it explores on"
        return Outcome(True, text)

    def _held(self) -> MissionPhase:
        """The phase that is paused, else the phase."""
        return self.paused_phase if self.phase == MissionPhase.PAUSED else self.phase

    def _idle(self, facts: Facts) -> None:
        if not facts.localised:
            self.reason = "waiting for odometry"
        elif self.config.auto_start:
            self._start(facts, "started by itself")
        else:
            self.reason = "waiting for the start command"

    def _start(self, facts: Facts, reason: str) -> None:
        self.phase, self.reason = MissionPhase.EXPLORE, reason
        self.started_ns, self.start_m = facts.now_ns, facts.distance_m
        self._restart_timers(facts)

    def _resume(self, facts: Facts) -> None:
        self.phase, self.reason = self.paused_phase, "resumed by the operator"
        self._restart_timers(facts)

    def _restart_timers(self, facts: Facts) -> None:
        self.settled_since_ns, self.last_step_ns = -1, facts.now_ns

    def _go_home(self, pending: FinishReason, reason: str, facts: Facts) -> None:
        self.phase, self.pending, self.reason = MissionPhase.RETURN, pending, reason
        self.idle_ns, self.best_return_m = 0, math.inf
        self._restart_timers(facts)

    def _end(self, phase: MissionPhase, finish: FinishReason, reason: str, facts: Facts) -> None:
        self.phase, self.finish, self.reason = phase, finish, reason
        self.finished_ns = facts.now_ns

    def _end_or_go_home(self, finish: FinishReason, reason: str, home_first: bool, facts: Facts) -> None:
        if home_first:
            self._go_home(finish, f"{reason}: going home", facts)
        else:
            self._end(MissionPhase.DONE, finish, reason, facts)

    def _return(self, facts: Facts) -> None:
        if facts.home_distance_m <= self.config.home_radius_m:
            reason = "home again"
            if self.pending != FinishReason.RETURNED:
                reason = f"home again, turned back for: {self.pending.value}"
            self._end(MissionPhase.DONE, self.pending, reason, facts)
            return
        closer = facts.return_distance_m < self.best_return_m - self.config.progress_min_m
        self._count_idle(closer, facts)
        if closer:
            self.best_return_m = facts.return_distance_m
        if self.idle_ns >= self.config.no_progress_s * SECOND_NS:
            reason = (
                f"no closer to home for {self.config.no_progress_s:g} s, {facts.return_distance_m:.0f} m left"
            )
            self._end(MissionPhase.DONE, FinishReason.NO_PROGRESS, f"{reason} ({self.pending.value})", facts)

    def _explore(self, facts: Facts) -> None:
        for check in (self._check_covered, self._check_time, self._check_energy, self._check_progress):
            check(facts)
            if self.phase != MissionPhase.EXPLORE:
                return

    def _check_covered(self, facts: Facts) -> None:
        """Covered: for `settle_s` without a break there was no frontier, and something had been covered."""
        if not facts.settled or not facts.covered_area_m2:
            self.settled_since_ns = -1
            return
        if self.settled_since_ns < 0:
            self.settled_since_ns = facts.now_ns
        if facts.now_ns - self.settled_since_ns >= self.config.settle_s * SECOND_NS:
            reason = "all ground that could be reached and is worth the way is covered"
            if facts.left:
                reason += f"; {facts.left} places are left"
            self._end_or_go_home(FinishReason.COVERED, reason, self.config.return_when_done, facts)

    def _check_time(self, facts: Facts) -> None:
        if self.time_budget_s == 0:
            return
        left_s = self.time_budget_s - self.elapsed_s(facts.now_ns)
        self._check_budget(FinishReason.TIME_BUDGET, left_s, 1.0 / self.config.return_speed_mps, "s", facts)

    def _check_energy(self, facts: Facts) -> None:
        if self.config.energy_budget_m == 0:
            return
        left_m = self.config.energy_budget_m - (facts.distance_m - self.start_m)
        self._check_budget(FinishReason.ENERGY_BUDGET, left_m, 1.0, "m", facts)

    def _check_budget(
        self, finish: FinishReason, left: float, cost_per_m: float, unit: str, facts: Facts
    ) -> None:
        """Turn back while what is left covers the way home with the reserve; without a return, use it all."""
        go_home = self.config.return_on_budget
        need = self.config.return_reserve_factor * facts.return_distance_m * cost_per_m if go_home else 0.0
        if left > need:
            return
        reason = f"{max(left, 0.0):.0f} {unit} of the {finish.value.replace('_', ' ')} left"
        if go_home:
            reason += (
                f", the way back of {facts.return_distance_m:.0f} m and its reserve need {need:.0f} {unit}"
            )
        self._end_or_go_home(finish, reason, go_home, facts)

    def _check_progress(self, facts: Facts) -> None:
        area = facts.covered_area_m2
        if area is not None:
            self._rebase(area)
        grown = area is not None and area >= self.best_area_m2 + self.config.progress_min_m2
        self._count_idle(grown, facts)
        if grown and area is not None:
            self.best_area_m2 = area
        if self.idle_ns >= self.config.no_progress_s * SECOND_NS:
            reason = f"nothing new covered for {self.config.no_progress_s:g} s, {facts.left} places left"
            self._end_or_go_home(FinishReason.NO_PROGRESS, reason, self.config.return_when_done, facts)

    def _rebase(self, area_m2: float) -> None:
        """Count from less when ground that was covered is no longer believed to be in reach.

        Else a robot that covers new ground elsewhere makes no progress until that loss is made up for. So often only,
        unless there is more than ever before: ground that comes and goes is no progress.
        """
        if area_m2 >= self.peak_area_m2 + self.config.progress_min_m2:
            self.peak_area_m2, self.rebased = area_m2, 0
        if self.best_area_m2 - area_m2 > _REBASE_M2 and self.rebased < _MOST_REBASES:
            self.best_area_m2 = area_m2
            self.rebased += 1

    def _count_idle(self, progress: bool, facts: Facts) -> None:
        """Time without progress; pauses do not count, since the timer runs from step to step."""
        since_ns = facts.now_ns - self.last_step_ns if self.last_step_ns >= 0 else 0
        self.idle_ns = 0 if progress else self.idle_ns + since_ns

    def snapshot(self) -> dict[str, Any]:
        """All but the configuration, as plain values."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "config"}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        for name, value in snapshot.items():
            setattr(self, name, value)
        self.phase, self.paused_phase = MissionPhase(self.phase), MissionPhase(self.paused_phase)
        self.finish, self.pending = FinishReason(self.finish), FinishReason(self.pending)
