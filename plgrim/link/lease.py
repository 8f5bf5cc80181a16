"""Who of two instances of a stage is obeyed: a lease that the robot grants, with an epoch that only grows.

A pure state machine, stepped with times in ns of the robot's own monotonic clock: no clock of the base decides.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from schemas.contract import SECOND_NS

BASE, STANDBY = "base", "standby"
_SHORT_TENURE_NS = 20 * SECOND_NS
_MOST_DOUBLINGS = 3
_NEVER = -(2**62)


@dataclass(frozen=True, slots=True)
class LeaseTimes:
    """silent_after: without a good word for so long, an instance counts as silent. hand_back_after: the base must have
    been in step for so long; doubled, up to 8 times, when its last lease was lost within 20 s.
    """

    silent_after_ns: int
    hand_back_after_ns: int


@dataclass(slots=True)
class Lease:
    """Begins with the standby as holder. Call `good` and `bad` as words come in, `tick` often."""

    times: LeaseTimes
    epoch: int
    holder: str = STANDBY
    takeovers: int = 0
    hand_backs: int = 0
    _last_good: dict[str, int] = field(default_factory=dict)
    _good_since: dict[str, int] = field(default_factory=dict)
    _granted_ns: int = _NEVER
    _doublings: int = 0

    def good(self, instance: str, now_ns: int) -> None:
        """A word of an instance that is in step."""
        if not self._is_heard(instance, now_ns):
            self._good_since.pop(instance, None)
        self._good_since.setdefault(instance, now_ns)
        self._last_good[instance] = max(now_ns, self._last_good.get(instance, _NEVER))

    def bad(self, instance: str) -> None:
        """A word of an instance that is not in step: its time in step begins anew."""
        self._good_since.pop(instance, None)

    def _is_heard(self, instance: str, now_ns: int) -> bool:
        return now_ns - self._last_good.get(instance, _NEVER) <= self.times.silent_after_ns

    def good_age_ns(self, instance: str, now_ns: int) -> int:
        """Time since the last good word; -1 when there was none."""
        last = self._last_good.get(instance)
        return -1 if last is None else now_ns - last

    def tick(self, now_ns: int, base_lags: bool = False) -> bool:
        """Grant the lease anew where that is due; True when it has changed hands.

        base_lags: the standby has answered what the base has not.
        """
        if self.holder == BASE:
            if self._is_heard(BASE, now_ns) and not base_lags:
                return False
            short = now_ns - self._granted_ns < _SHORT_TENURE_NS
            self._doublings = min(self._doublings + 1, _MOST_DOUBLINGS) if short else 0
            self.takeovers += 1
            self._good_since.pop(BASE, None)
            return self._grant(STANDBY, now_ns)
        if base_lags or not self._is_in_step(now_ns):
            return False
        self.hand_backs += 1
        return self._grant(BASE, now_ns)

    def _is_in_step(self, now_ns: int) -> bool:
        since = self._good_since.get(BASE)
        if since is None or not self._is_heard(BASE, now_ns):
            return False
        if self._last_good.get(STANDBY) is not None and not self._is_heard(STANDBY, now_ns):
            return True  # the standby has died: better the base at once than nobody
        return now_ns - since >= self.times.hand_back_after_ns << self._doublings

    def _grant(self, to: str, now_ns: int) -> bool:
        self.holder, self._granted_ns = to, now_ns
        self.epoch += 1
        return True
