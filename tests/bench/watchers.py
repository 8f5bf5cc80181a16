"""What watching costs the planners: `python -m tests.bench.watchers --url URL`, beside a mission on this host.

Rounds of two windows, in turn without and with watchers: 20 clients that poll the status each second, and 5 WebSockets
of the live page that acknowledge at once. A planner's step time in a window is the time that its process ran or waited
for a core (Linux, /proc/PID/task/*/schedstat), over the steps that it made. Printed: for each planner the ratio with
over without, median and range of the rounds. Exit 1 when a planner's median ratio is over 1.05.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import httpx
import msgpack
import websockets

PLANNERS = ("riskmap", "irm", "gcp", "lcp", "reconciler", "mission")
LIMIT = 1.05


async def poll(client: httpx.AsyncClient, url: str, every_s: float) -> None:
    """One client that asks for the status again and again."""
    while True:
        (await client.get(f"{url}/api/v1/status")).raise_for_status()
        await asyncio.sleep(every_s)


async def watch(url: str, frames: list[int]) -> None:
    """One page: everything at first, then what changes. frames: counts what came."""
    async with websockets.connect(url.replace("http", "ws", 1) + "/api/v1/live", max_size=None) as socket:
        await socket.send("{}")
        async for frame in socket:
            version = msgpack.unpackb(frame)["version"]
            frames[0] += 1
            await socket.send(json.dumps({"version": version}))


def busy_ms(pid: int) -> float:
    """Time that a process' threads have run or waited for a core, ms."""
    total = 0
    for stat in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        ran, waited, _ = stat.read_text(encoding="ascii").split()
        total += int(ran) + int(waited)
    return total / 1e6


async def counts(client: httpx.AsyncClient, url: str) -> dict[str, tuple[float, int]]:
    """Busy ms and steps so far, of each planner."""
    report: dict[str, Any] = (await client.get(f"{url}/api/v1/status")).json()
    known = [stage for stage in report["stages"] if stage["service"] in PLANNERS and stage["pid"]]
    return {stage["service"]: (busy_ms(stage["pid"]), stage["steps"]) for stage in known}


async def window(
    client: httpx.AsyncClient, url: str, args: argparse.Namespace, watched: bool
) -> dict[str, float]:
    """Mean step time of each planner in one window, ms."""
    frames = [0]
    watchers = [poll(client, url, args.every_s) for _ in range(args.clients)] if watched else []
    watchers += [watch(url, frames) for _ in range(args.sockets)] if watched else []
    tasks = [asyncio.create_task(one) for one in watchers]
    await asyncio.sleep(2.0)
    before = await counts(client, url)
    await asyncio.sleep(args.window_s)
    after = await counts(client, url)
    gone = [task for task in tasks if task.done()]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    if gone:
        raise RuntimeError(f"{len(gone)} watchers ended by themselves: {gone[0].exception()}")
    if watched:
        print(
            f"  {frames[0] / (args.window_s + 2) / max(args.sockets, 1):.1f} frames a second to each page",
            flush=True,
        )
    made = {name: after[name][1] - before[name][1] for name in before if name in after}
    return {name: (after[name][0] - before[name][0]) / steps for name, steps in made.items() if steps > 0}


async def run(args: argparse.Namespace) -> int:
    """All rounds; the exit code."""
    ratios: dict[str, list[float]] = {name: [] for name in PLANNERS}
    limits = httpx.Limits(max_connections=args.clients + 2)
    async with httpx.AsyncClient(trust_env=False, timeout=30, limits=limits) as client:
        for number in range(args.rounds):
            # In turn: what drifts with the mission weighs on both alike.
            order = (False, True) if number % 2 == 0 else (True, False)
            found = {watched: await window(client, args.url, args, watched) for watched in order}
            for name, without in found[False].items():
                if without > 0 and name in found[True]:
                    ratios[name].append(found[True][name] / without)
    worst = 0.0
    for name, values in ratios.items():
        if values:
            middle = statistics.median(values)
            worst = max(worst, middle)
            print(
                f"{name:>11}  x {middle:.3f}  ({min(values):.3f} to {max(values):.3f}, {len(values)} rounds)"
            )
    return 1 if worst > LIMIT or worst == 0.0 else 0


def main() -> int:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", default="http://127.0.0.1:8080")
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--sockets", type=int, default=5)
    parser.add_argument("--every-s", type=float, default=1.0, help="between two questions of a client")
    parser.add_argument("--window-s", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=4)
    return asyncio.run(run(parser.parse_args()))


if __name__ == "__main__":
    sys.exit(main())
