"""Heavy answers: one at a time, the same for all who wait, never older than the question."""

from __future__ import annotations

import asyncio
import threading
import time
import tracemalloc

import httpx
import numpy as np
import pytest

from services.status.app import SharedStatus, create_app
from services.status.config import Config
from services.status.once import Once
from tests.status.scene import Scene


class Maker:
    """Makes numbers, slowly; knows how many were made at a time."""

    def __init__(self) -> None:
        self.made = 0
        self.now = 0
        self.most = 0
        self._lock = threading.Lock()

    def __call__(self) -> int:
        with self._lock:
            self.now += 1
            self.most = max(self.most, self.now)
        time.sleep(0.01)
        with self._lock:
            self.now -= 1
            self.made += 1
            return self.made


def test_all_who_wait_get_the_same_and_never_are_two_made_at_a_time() -> None:
    maker = Maker()

    async def ask() -> list[int]:
        once = Once()
        return await asyncio.gather(*(once.get("a" if n % 2 else "b", maker) for n in range(40)))

    answers = asyncio.run(ask())
    assert maker.most == 1
    assert maker.made == 3  # for who came first; then one for each key
    assert sorted(set(answers)) == [1, 2, 3]
    assert answers.count(1) == 1


def test_who_asks_while_one_is_made_gets_a_later_one() -> None:
    told: list[str] = []
    state = ["old"]

    async def ask() -> None:
        once = Once()
        begun = threading.Event()

        def make() -> str:
            seen = state[0]
            begun.set()
            time.sleep(0.05)
            return seen

        first = asyncio.create_task(once.get("a", make))
        while not begun.is_set():
            await asyncio.sleep(0.001)
        state[0] = "new"
        told.extend(await asyncio.gather(first, once.get("a", make), once.get("a", make)))

    asyncio.run(ask())
    assert told == ["old", "new", "new"]


def test_nothing_is_kept_when_nobody_waits_and_errors_reach_who_asked() -> None:
    def fail() -> int:
        raise ValueError("no map")

    async def ask() -> None:
        once = Once()
        assert [await once.get("a", maker), await once.get("a", maker)] == [1, 2]
        with pytest.raises(ValueError, match="no map"):
            await once.get("a", fail)
        assert await once.get("a", maker) == 3
        assert not once._made
        assert not once._waiting

    maker = Maker()
    asyncio.run(ask())


def test_many_readers_of_the_map_cost_the_memory_of_one() -> None:
    """Of what Python and numpy hold: twenty at a time must not cost twice what one does."""
    shared = SharedStatus(Config(), "husky1")
    Scene(shared, risk_cells=100, graph_side=40).step()
    side = 6
    shared.read(lambda core, now_ns: core.canvas.set_state(_canvas(side)))
    app = create_app(shared)

    async def peak_of(readers: int, path: str) -> int:
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8080") as client:
            before, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
            answers = await asyncio.gather(*(client.get(path) for _ in range(readers)))
            assert {answer.status_code for answer in answers} == {200}
            return tracemalloc.get_traced_memory()[1] - before

    async def all_of_them() -> None:
        for path in ("/api/v1/layers/coverage.png", "/map.png", "/api/v1/graph.geojson"):
            await peak_of(1, path)  # what is made but once
            one, twenty = await peak_of(1, path), await peak_of(20, path)
            print(f"\n{path}: {one / 1e6:.1f} MB for one, {twenty / 1e6:.1f} MB for twenty")
            assert twenty < 2 * one + 20 * 100_000, path  # the margin: of each request itself

    tracemalloc.start()
    try:
        asyncio.run(all_of_them())
    finally:
        tracemalloc.stop()


def _canvas(side: int) -> dict[str, object]:
    cells = (np.indices((256, 256)).sum(axis=0) % 3).astype(np.uint8)
    return {"resolution_m": 0.2, "tiles": [[x, y, cells] for x in range(side) for y in range(side)]}
