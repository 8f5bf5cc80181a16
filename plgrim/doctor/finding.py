"""One thing that was looked at."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What was looked at, how it is, and what the user can do about it (empty when nothing need be done)."""

    name: str
    level: Level
    says: str
    mend: str = ""

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)
