"""How far an instance is behind the robot, by the robot's own clock alone.

Every message names the inputs it was made from (epoch and sequence). The link process has seen these inputs go by and
knows when: so the age of what the base knows needs no clock of the base, and no jump of a clock changes it. Of what it
has not seen go by it knows no age: that is not in step, however new it may be.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from schemas.contract import SECOND_NS

Mark = tuple[int, int]
UNKNOWN_NS = 2**62
"""The lag of what was made from something that the link process has not seen: longer than any limit."""
_KEPT = 512
_HISTORY_NS = SECOND_NS // 2
"""What comes so soon after the first of a topic may be a writer's cache, told at once: of it only the newest is new."""


@dataclass(slots=True)
class Seen:
    """When which message of each topic came, the newest 512 of each."""

    _marks: dict[str, list[Mark]] = field(default_factory=dict)
    _times: dict[str, list[int]] = field(default_factory=dict)

    def note(self, topic: str, mark: Mark, now_ns: int) -> None:
        """A message has come; mark: its (epoch, sequence). What is not newer than the last one is ignored."""
        marks, times = self._marks.setdefault(topic, []), self._times.setdefault(topic, [])
        if marks and mark <= marks[-1]:
            return
        marks.append(mark)
        times.append(now_ns)
        if len(marks) == 2 and times[1] - times[0] <= _HISTORY_NS:
            del marks[0], times[1]
        if len(marks) > 2 * _KEPT:
            del marks[:-_KEPT], times[:-_KEPT]

    def behind_ns(self, topic: str, mark: Mark, now_ns: int) -> int:
        """For how long there has been something newer than this; 0 when it is the newest, UNKNOWN_NS outside of what
        was seen.
        """
        marks = self._marks.get(topic)
        if not marks or not marks[0] <= mark <= marks[-1]:
            return UNKNOWN_NS
        at = bisect_right(marks, mark)
        return now_ns - self._times[topic][at] if at < len(marks) else 0

    def newest(self, topic: str) -> Mark | None:
        """The last mark of a topic; None when nothing has come."""
        marks = self._marks.get(topic)
        return marks[-1] if marks else None

    def forget(self, topic: str) -> None:
        """Its marks begin anew."""
        self._marks.pop(topic, None)
        self._times.pop(topic, None)

    def lag_ns(self, consumed: Mapping[str, Mark], topics: Iterable[str], now_ns: int) -> int:
        """The largest `behind_ns` over those topics of which something was consumed."""
        lags = [self.behind_ns(name, consumed[name], now_ns) for name in topics if name in consumed]
        return max(lags, default=0)

    def has(self, topic: str) -> bool:
        """Whether anything of a topic has come."""
        return bool(self._marks.get(topic))
