"""What waits to be sent on one connection: the newest of most topics, everything of a few, within byte budgets.

A lane has no thread and no clock. A message that waits while the link is slow or gone is replaced by the next one of
its topic, so that what is sent is always the newest and memory stays flat.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field

from plgrim.link.budget import Bucket
from schemas.base import Message
from schemas.contract import Topic


@dataclass(frozen=True, slots=True)
class Parcel:
    """One message to be sent. whole: it stands for all that was said before it on its topic (a whole graph)."""

    topic: Topic[Message]
    payload: bytes
    whole: bool = False


def _bytes_beside_wholes(queue: deque[Parcel]) -> int:
    return sum(len(waiting.payload) for waiting in queue if not waiting.whole)


@dataclass(slots=True)
class Lane:
    """Not thread safe: the sender locks around it.

    every: topics of which every message is sent, in order, before all others. limit_bytes: what one of them may keep
    waiting, but for a whole. Of differences (`differences`) all are dropped when one has to be: the reader asks for the
    whole anew. A whole takes the place of all before it and is never dropped, however large it is: the reader that
    asked for it would ask for ever. Of other topics the oldest go. replaced, dropped: counted by topic.
    """

    budget: Bucket
    topic_budgets: dict[str, Bucket] = field(default_factory=dict)
    every: frozenset[str] = frozenset()
    differences: frozenset[str] = frozenset()
    limit_bytes: int = 2_000_000
    replaced: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    _queues: dict[str, deque[Parcel]] = field(default_factory=dict)
    _newest: OrderedDict[str, Parcel] = field(default_factory=OrderedDict)
    _held_until: dict[str, int] = field(default_factory=dict)

    def offer(self, parcel: Parcel) -> None:
        """Take in a message to send."""
        name = parcel.topic.name
        if name not in self.every:
            # A topic keeps its place in the line, whichever of its messages is the newest: none is starved.
            self.replaced[name] += name in self._newest
            self._newest[name] = parcel
            return
        queue = self._queues.setdefault(name, deque())
        if parcel.whole:
            self.replaced[name] += len(queue)
            queue.clear()
        queue.append(parcel)
        while len(queue) > 1 and _bytes_beside_wholes(queue) > self.limit_bytes:
            kept = (
                [waiting for waiting in queue if waiting.whole]
                if name in self.differences
                else list(queue)[1:]
            )
            self.dropped[name] += len(queue) - len(kept)
            queue.clear()
            queue.extend(kept)

    def put_back(self, parcel: Parcel, until_ns: int) -> None:
        """A message of a topic in `every` could not be sent yet: it stays the next of its topic, from then on."""
        name = parcel.topic.name
        self._queues.setdefault(name, deque()).appendleft(parcel)
        self._held_until[name] = until_ns

    def take(self, now_ns: int) -> tuple[Parcel | None, int]:
        """The next message to send now, or None and the time to wait (ns; -1: until something is offered)."""
        names = [name for name, queue in self._queues.items() if queue] + list(self._newest)
        if not names:
            return None, -1
        wait_ns = self.budget.wait_ns(now_ns)
        if wait_ns > 0:
            return None, wait_ns
        waits = []
        for name in names:
            bucket = self.topic_budgets.get(name)
            wait_ns = max(
                self._held_until.get(name, now_ns) - now_ns, bucket.wait_ns(now_ns) if bucket else 0
            )
            if wait_ns <= 0:
                return self._pop(name), 0
            waits.append(wait_ns)
        return None, min(waits)

    def _pop(self, name: str) -> Parcel:
        queue = self._queues.get(name)
        return queue.popleft() if queue else self._newest.pop(name)

    def spent(self, topic: str, size: int, now_ns: int) -> None:
        """A message of this topic took so many bytes on the link."""
        self.budget.spend(size, now_ns)
        if topic in self.topic_budgets:
            self.topic_budgets[topic].spend(size, now_ns)

    @property
    def waiting_bytes(self) -> int:
        """Of all messages that wait, before they are made small."""
        queued = sum(len(p.payload) for queue in self._queues.values() for p in queue)
        return queued + sum(len(p.payload) for p in self._newest.values())
