"""Heavy answers (whole graphs, pictures of the map), made one at a time: many who ask wait for the same one.

Drawn for every request at once, twenty of them took a gigabyte, and the robot's messages waited for them.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

_T = TypeVar("_T")


class Once:
    """Makes answers in one thread of its own, one after the other.

    What is made after somebody asked is fresh enough for them: all who wait for the same answer get it, and it is
    forgotten when nobody waits any more. Used from one event loop.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="status-heavy")
        self._making = asyncio.Lock()
        self._counted = itertools.count(1)
        self._waiting: Counter[str] = Counter()
        self._made: dict[str, tuple[int, object]] = {}

    async def get(self, key: str, make: Callable[[], _T]) -> _T:
        """What `make()` gives; key: of all answers that may stand for each other. Raises what `make` raises."""
        came = next(self._counted)
        self._waiting[key] += 1
        try:
            async with self._making:
                began, made = self._made.get(key, (0, None))
                if began < came:
                    began = next(self._counted)
                    made = await asyncio.get_running_loop().run_in_executor(self._thread, make)
                    self._made[key] = began, made
                return cast(_T, made)
        finally:
            self._waiting[key] -= 1
            if not self._waiting[key]:
                del self._waiting[key]
                self._made.pop(key, None)
