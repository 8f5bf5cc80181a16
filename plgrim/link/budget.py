"""How much a link may carry, and how much it does. No clock: times are given, in ns of a local monotonic one."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

from schemas.contract import SECOND_NS

_BURST_S = 0.5
_SPAN_NS = 5 * SECOND_NS


@dataclass(slots=True)
class Bucket:
    """A token bucket that may go into debt: a message goes when nothing is owed, whatever its size.

    Over any time the bytes spent stay below `rate * time + burst + one message`.
    """

    bytes_per_s: float
    _tokens: float = field(init=False)
    _filled_ns: int = -1

    def __post_init__(self) -> None:
        self._tokens = self._most

    @property
    def _most(self) -> float:
        return self.bytes_per_s * _BURST_S

    def _fill(self, now_ns: int) -> None:
        if self._filled_ns >= 0:
            gained = self.bytes_per_s * max(0, now_ns - self._filled_ns) / SECOND_NS
            self._tokens = min(self._most, self._tokens + gained)
        self._filled_ns = max(now_ns, self._filled_ns)

    def wait_ns(self, now_ns: int) -> int:
        """Time until something may be sent; 0: now."""
        self._fill(now_ns)
        return 0 if self._tokens > 0 else int(-self._tokens / self.bytes_per_s * SECOND_NS) + 1

    def spend(self, size: int, now_ns: int) -> None:
        """So many bytes were sent."""
        self._fill(now_ns)
        self._tokens -= size


@dataclass(slots=True)
class Meter:
    """Bytes by topic over the last five seconds; safe to use from several threads."""

    total: dict[str, int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _spent: dict[str, deque[tuple[int, int]]] = field(default_factory=dict)

    def count(self, topic: str, size: int, now_ns: int) -> None:
        """So many bytes of a topic now."""
        with self._lock:
            self.total[topic] = self.total.get(topic, 0) + size
            self._spent.setdefault(topic, deque()).append((now_ns, size))
            self._forget(topic, now_ns)

    def _forget(self, topic: str, now_ns: int) -> None:
        spent = self._spent[topic]
        while spent and now_ns - spent[0][0] > _SPAN_NS:
            spent.popleft()

    def kb_per_s(self, now_ns: int) -> dict[str, float]:
        """By topic, in 1000 bytes/s; topics that were silent are left out."""
        seconds = _SPAN_NS / SECOND_NS
        with self._lock:
            for topic in self._spent:
                self._forget(topic, now_ns)
            return {
                topic: round(sum(size for _, size in spent) / seconds / 1000, 3)
                for topic, spent in sorted(self._spent.items())
                if spent
            }
