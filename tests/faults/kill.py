"""Kills services with SIGKILL in mid-mission and reports what it cost: `python -m tests.faults.kill --help`.

Every service is a process of its own under the supervisor, over Zenoh, as in `plgrim explore`. After each kill the
next one waits until the service is back and a random while longer. Missions follow one another until every service has
had its kills; each goes on to its end. The last line says whether the acceptance holds.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from planning.randomness import stream
from plgrim.config import Config, load_config
from plgrim.logs import configure_logs
from plgrim.runtime.supervisor import Child, Supervisor
from schemas.topics import SERVICES
from tests.faults.observer import Handover, Observer

BACK_WITHIN_S = 5.0
_GIVE_UP_S = 60.0
_SPARE_WAIT_S = 30.0
"""Longest wait for the supervisor's warm spare before the next kill: a robot loses a process now and then, not ten a
minute. On a busy machine the spare takes that long; the kill comes all the same then."""


@dataclass(slots=True)
class Kill:
    """One kill: of whom, when (mission seconds), and how long until it was ready and said something valid (wall s)."""

    service: str
    mission_s: float
    killed_s: float
    epoch: int
    ready_s: float | None = None
    output_s: float | None = None

    @property
    def back_s(self) -> float | None:
        """Wall seconds until it was ready and had said something valid."""
        return None if self.ready_s is None or self.output_s is None else max(self.ready_s, self.output_s)


@dataclass(slots=True)
class Mission:
    """What came of one mission. handovers: one for each restart of irm."""

    finish: str
    coverage_judge: float
    lost: bool
    elapsed_s: float
    wall_s: float
    nodes: int
    edges: int
    gaps: int
    kills: list[Kill]
    handovers: list[Handover]
    setbacks: dict[str, list[float]] = field(default_factory=dict)

    def faults(self, within_s: float = BACK_WITHIN_S) -> list[str]:
        """In plain words, what is not as it must be. within_s: wall time that a service may take to be back."""
        found = [
            f"{kill.service} was not back within {within_s:g} s: {kill.back_s}"
            for kill in self.kills
            if kill.back_s is None or kill.back_s > within_s
        ]
        found += [fault for handover in self.handovers for fault in handover.faults()]
        found += [f"the judge took back {back:.4f}" for back in self.setbacks["judge"] if back > 1e-9]
        found += [f"the robot jumped {jump:.2f} m" for jump in self.setbacks["jump_m"] if jump > 1.0]
        if self.finish != "covered" or self.lost:
            found.append(f"the mission ended {self.finish or 'unfinished'}, lost: {self.lost}")
        return found


class Killer:
    """Runs one mission and kills through a list while it lasts. gap_s: range of the wall time between two kills.

    spare_wait_s: longest wait for the supervisor's spare before each.
    """

    def __init__(
        self,
        config: Config,
        folder: Path,
        gap_s: tuple[float, float] = (2.0, 6.0),
        spare_wait_s: float = _SPARE_WAIT_S,
    ) -> None:
        self._config = config
        self._folder = folder
        self._gap_s, self._spare_wait_s = gap_s, spare_wait_s
        self._rng: np.random.Generator = stream(config.seed, "faults", "kill")
        self._observer = Observer()
        self._kills: list[Kill] = []
        self._due_s = 0.0
        self._waited = False

    def run(self, services: list[str], limit_s: float) -> Mission:
        """Run a mission to its end or for `limit_s` wall seconds; takes from the front of `services` whom to kill."""
        began = time.monotonic()
        stop = threading.Event()
        with Supervisor(self._config, self._folder) as supervisor:
            link = supervisor.start()
            self._observer.attach(link)
            supervisor.wait_ready(stop)
            self._wait_for_next()
            while not self._observer.finish and time.monotonic() - began < limit_s:
                supervisor.poll()
                self._look()
                if (
                    services
                    and supervisor.children[services[0]].ready
                    and time.monotonic() >= self._due_s
                    and self._all_back()
                    and self._is_whole(supervisor)
                ):
                    self._kill(supervisor.children[services.pop(0)])
                if self._observer.judge is not None and self._observer.judge.lost:
                    break
                time.sleep(0.02)
            self._settle(supervisor)
            supervisor.finished = bool(self._observer.finish)
        return self._mission(time.monotonic() - began)

    def _wait_for_next(self) -> None:
        self._due_s = time.monotonic() + float(self._rng.uniform(*self._gap_s))

    def _is_whole(self, supervisor: Supervisor) -> bool:
        """Whether the supervisor has a spare again; it need not be waited for without end.

        The random gap begins anew then, so that the phase of the kill is random all the same.
        """
        waited_s = time.monotonic() - self._due_s
        if not supervisor.spare_warm and waited_s < self._spare_wait_s:
            self._waited = True
            return False
        if self._waited:
            self._waited = False
            self._due_s = time.monotonic() + float(self._rng.uniform(0.0, 2.0))
            return False
        return True

    def _all_back(self) -> bool:
        if not self._kills:
            return True
        last = self._kills[-1]
        return last.back_s is not None or time.monotonic() - last.killed_s > _GIVE_UP_S

    def _kill(self, child: Child) -> None:
        process = child.process
        assert process is not None
        mission = self._observer.mission
        mission_s = mission.elapsed_s if mission else 0.0
        epoch = self._observer.health[child.name].epoch
        os.kill(process.pid, signal.SIGKILL)
        self._kills.append(Kill(child.name, mission_s, time.monotonic(), epoch))

    def _look(self) -> None:
        """Whether the one that was killed last has come back."""
        if not self._kills or self._kills[-1].back_s is not None:
            return
        kill = self._kills[-1]
        health, output = self._observer.health[kill.service], self._observer.outputs[kill.service]
        if health.epoch > kill.epoch and health.ready_s is not None:
            kill.ready_s = health.ready_s - kill.killed_s
        if output.epoch > kill.epoch:
            kill.output_s = output.first_s - kill.killed_s
        if kill.back_s is not None:
            _say(
                f"  {kill.mission_s:6.1f} s  {kill.service:<10} ready {kill.ready_s:5.2f} s, "
                f"first valid output {kill.output_s:5.2f} s"
            )
            self._wait_for_next()

    def _settle(self, supervisor: Supervisor) -> None:
        """After the end: a service that was just killed comes back all the same, and the judge says its last word."""
        deadline = time.monotonic() + 20.0
        while not self._all_back() and time.monotonic() < deadline:
            supervisor.poll()
            self._look()
            time.sleep(0.02)
        if (
            self._kills
            and self._kills[-1].back_s is None
            and self._kills[-1].service in ("lcp", "reconciler")
        ):
            self._kills.pop()  # nobody asks for plans any more: that is no failure to come back
        time.sleep(1.0)

    def _mission(self, wall_s: float) -> Mission:
        seen = self._observer
        nodes, edges = seen.graph_size()
        return Mission(
            finish=seen.finish,
            coverage_judge=seen.judge.coverage if seen.judge else 0.0,
            lost=seen.judge.lost if seen.judge else False,
            elapsed_s=seen.mission.elapsed_s if seen.mission else 0.0,
            wall_s=wall_s,
            nodes=nodes,
            edges=edges,
            gaps=seen.gaps,
            kills=self._kills,
            handovers=list(seen.handovers),
            setbacks={
                "judge": list(seen.judge_setbacks),
                "belief_m2": list(seen.belief_setbacks_m2),
                "jump_m": list(seen.jumps_m),
                "clock_s": list(seen.clock_setbacks_s),
            },
        )


def _say(text: str) -> None:
    print(text, flush=True)


def free_port() -> int:
    """A loopback port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def fault_config(
    sim: dict[str, Any], seed: int, speed: float, runtime: dict[str, Any] | None = None
) -> Config:
    """A configuration of its own ports and clock, that forgives as many restarts as are caused here."""
    return load_config(
        overrides={
            "seed": seed,
            "router": {"endpoint": f"tcp/127.0.0.1:{free_port()}"},
            "clock": {"speed": speed, "origin_ns": time.monotonic_ns()},
            "runtime": {"restarts": 50, "health_period_s": 0.1, **(runtime or {})},
            "sim": sim,
            "status": {"port": free_port()},
        }
    )


def schedule(services: Sequence[str], times: int, seed: int) -> list[str]:
    """Each service so many times, in random order."""
    order = list(services) * times
    stream(seed, "faults", "order").shuffle(order)
    return order


def report(missions: list[Mission]) -> list[str]:
    """The figures, and what is wrong; prints both."""
    kills = [kill for mission in missions for kill in mission.kills]
    _say("\nservice      kills  ready s (median, worst)  first valid output s (median, worst)")
    for service in sorted({kill.service for kill in kills}, key=SERVICES.index):
        mine = [kill for kill in kills if kill.service == service]
        ready = sorted(k.ready_s for k in mine if k.ready_s is not None)
        output = sorted(k.output_s for k in mine if k.output_s is not None)
        columns = [
            f"{v[len(v) // 2]:8.2f} {v[-1]:8.2f}" if v else "       -        -" for v in (ready, output)
        ]
        _say(f"{service:<12} {len(mine):5d}  {columns[0]:>22}  {columns[1]:>30}")
    for number, mission in enumerate(missions, 1):
        _say(
            f"\nmission {number}: {mission.finish or 'not finished'}, judge {100 * mission.coverage_judge:.1f} %, "
            f"{mission.elapsed_s:.0f} s of mission in {mission.wall_s:.0f} s, {len(mission.kills)} kills, "
            f"{mission.nodes} nodes and {mission.edges} edges at the end"
        )
        for h in mission.handovers:
            _say(
                f"  irm: {h.nodes} nodes and {h.edges} edges acknowledged before the kill, lost {h.lost_nodes} and "
                f"{h.lost_edges}" + ("" if h.version_step == 1 else f" (version went on by {h.version_step})")
            )
        for name, values in mission.setbacks.items():
            if values:
                _say(f"  {name} back by at most {max(values):.3f} over {len(values)} restarts")
    faults = [fault for mission in missions for fault in mission.faults()]
    _say(
        "\n"
        + ("\n".join(faults) if faults else "accepted: all came back in time, nothing acknowledged was lost")
    )
    return faults


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="subway_1x")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", type=float, default=2.0, help="mission seconds a wall second")
    parser.add_argument("--times", type=int, default=5, help="kills of each service")
    parser.add_argument("--services", nargs="+", default=list(SERVICES), choices=SERVICES)
    parser.add_argument("--limit", type=float, default=1800.0, help="wall seconds of one mission")
    parser.add_argument(
        "--out", type=Path, help="where logs and configuration go (default: a temporary folder)"
    )
    arguments = parser.parse_args()
    configure_logs("faults")
    folder = arguments.out or Path(tempfile.mkdtemp(prefix="plgrim-faults-"))
    _say(f"logs in {folder}")
    left = schedule(arguments.services, arguments.times, arguments.seed)
    missions: list[Mission] = []
    while left:
        seed = arguments.seed + len(missions)
        config = fault_config({"world": arguments.world}, seed, arguments.speed)
        _say(f"mission {len(missions) + 1}: {arguments.world}, seed {seed}, {len(left)} kills to go")
        missions.append(Killer(config, folder / f"mission{len(missions) + 1}").run(left, arguments.limit))
        if not missions[-1].kills:
            break
    sys.exit(1 if report(missions) else 0)


if __name__ == "__main__":
    main()
