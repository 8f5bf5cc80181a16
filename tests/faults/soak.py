"""The whole live system for ten minutes, measured against its budgets: `python -m tests.faults.soak --minutes 10`.

Rates: of each periodic topic, on average within 3 % of nominal, no interval over 2.5 periods. CPU and memory: of each
process under its budget. Memory: no slope after the warm-up. The last line says whether all of it holds. For a machine
of 2 cores with nothing else to do.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from plgrim.logs import configure_logs
from plgrim.runtime.supervisor import Supervisor
from plgrim.runtime.zenoh_session import Link
from schemas.base import Message
from schemas.contract import SECOND_NS, Topic
from schemas.topics import SERVICES, TOPICS, health_topic
from tests.faults.kill import fault_config

RATE_WITHIN, LONGEST_PERIODS = 0.03, 2.5
SLOPE_MIB_PER_MIN = 1.0
"""Less than this a minute counts as no slope: the graph and the covered ground grow as long as the robot explores."""
BUDGET: dict[str, tuple[float, float]] = {
    "router": (0.15, 120.0),
    "riskmap": (0.50, 450.0),
    "irm": (0.35, 500.0),
    "gcp": (0.20, 350.0),
    "lcp": (0.25, 380.0),
    "reconciler": (0.25, 380.0),
    "mission": (0.12, 330.0),
    "status": (0.30, 350.0),
    "sim": (0.60, 420.0),
}
"""Of one core (share of the time), and resident memory (MiB), on average and at most, at speed 1."""
NOT_PERIODIC = frozenset({"reconciler/plan", "lcp/local_policy", "reconciler/episode", "sim/pose_graph"})
"""Sent when there is something to say, at most once a period: no rate to keep."""


@dataclass(slots=True)
class Rates:
    """Arrival times of every message of a topic (monotonic s)."""

    at_s: dict[str, list[float]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def attach(self, link: Link, topics: list[Topic[Message]]) -> None:
        """Listen, without decoding."""
        for topic in topics:
            self.at_s[topic.name] = []
            link.subscribe(topic, self._hear, every=True)

    def _hear(self, topic: Topic[Message], payload: bytes) -> None:
        del payload
        with self._lock:
            self.at_s[topic.name].append(time.monotonic())


def watched_topics() -> list[Topic[Message]]:
    """The topics that have a rate to keep."""
    mine = [t for t in TOPICS if t.period_ns and t.name not in NOT_PERIODIC and t.writer in SERVICES]
    return mine + [health_topic(service) for service in SERVICES]


def judge_rate(name: str, period_s: float, at_s: list[float]) -> tuple[str, list[str]]:
    """A line of the table, and what is wrong."""
    gaps = np.diff(np.asarray(at_s))
    if gaps.size < 10:
        return f"{name:<24} heard {len(at_s)} times", [f"{name} was heard {len(at_s)} times"]
    off, longest = float(np.mean(gaps) / period_s - 1.0), float(gaps.max() / period_s)
    line = f"{name:<24} {1 / period_s:7.2f} {100 * off:+7.2f} % {longest:8.2f}"
    wrong = [f"{name}: the rate is off by {-100 * off:.1f} %"] if abs(off) > RATE_WITHIN else []
    if longest > LONGEST_PERIODS:
        wrong.append(f"{name}: an interval of {longest:.1f} periods")
    return line, wrong


def judge_process(name: str, cpu: float, minutes: list[float], mib: list[float]) -> tuple[str, list[str]]:
    """A line of the table, and what is wrong. cpu: share of a core. The first third is warm-up."""
    warm = len(mib) // 3
    slope = float(np.polyfit(minutes[warm:], mib[warm:], 1)[0]) if len(mib) - warm > 2 else 0.0
    cpu_most, mib_most = BUDGET[name]
    line = (
        f"{name:<12} {100 * cpu:6.1f} % of {100 * cpu_most:3.0f} % "
        f"{max(mib):7.0f} of {mib_most:4.0f} MiB {slope:+7.2f} MiB/min"
    )
    wrong = [f"{name}: {100 * cpu:.0f} % CPU"] if cpu > cpu_most else []
    wrong += [f"{name}: {max(mib):.0f} MiB"] if max(mib) > mib_most else []
    wrong += [f"{name}: memory grows by {slope:.1f} MiB/min"] if slope > SLOPE_MIB_PER_MIN else []
    return line, wrong


def soak(minutes: float, world: str, folder: Path) -> list[str]:
    """Run it, print the tables, give what is wrong."""
    rates, wrong = Rates(), []
    memory: dict[str, list[float]] = {name: [] for name in BUDGET}
    times: list[float] = []
    with Supervisor(fault_config({"world": world}, 1, 1.0, {"health_period_s": 0.5}), folder) as supervisor:
        link = supervisor.start()
        supervisor.wait_ready(threading.Event())
        settle = time.monotonic() + 20.0
        while time.monotonic() < settle or not supervisor.spare_warm:
            supervisor.poll()
            time.sleep(0.05)
        rates.attach(link, watched_topics())
        processes = {n: psutil.Process(c.process.pid) for n, c in supervisor.children.items() if c.process}
        before = {name: sum(process.cpu_times()[:2]) for name, process in processes.items()}
        began = time.monotonic()
        while (passed := time.monotonic() - began) < 60.0 * minutes:
            supervisor.poll()
            if passed >= 2.0 * len(times):
                times.append(passed / 60.0)
                for name, process in processes.items():
                    memory[name].append(process.memory_info().rss / 2**20)
            time.sleep(0.05)
        cpu = {n: (sum(p.cpu_times()[:2]) - before[n]) / passed for n, p in processes.items()}
        restarted = {n: c.restarted for n, c in supervisor.children.items() if c.restarted}
        flags = dict(supervisor.watch.flags)
    table: list[tuple[str, list[str]]] = [("\ntopic: nominal Hz, off, longest interval in periods", [])]
    table += [judge_rate(t.name, t.period_ns / SECOND_NS, rates.at_s[t.name]) for t in watched_topics()]
    table += [("\nprocess      CPU, memory, slope after the warm-up", [])]
    table += [judge_process(name, cpu[name], times, memory[name]) for name in BUDGET]
    for line, found in table:
        print(line)
        wrong += found
    print(
        f"\nflagged as late: {flags or 'nobody'}; restarted: {restarted or 'nobody'}; load {os.getloadavg()}"
    )
    return wrong + ([f"restarted: {restarted}"] if restarted else [])


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--world", default="subway_1x")
    arguments: Any = parser.parse_args()
    configure_logs("soak")
    wrong = soak(arguments.minutes, arguments.world, Path(tempfile.mkdtemp(prefix="plgrim-soak-")))
    print("\n" + ("\n".join(wrong) if wrong else "accepted: rates, CPU and memory are within their limits"))
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
