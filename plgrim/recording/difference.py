"""Where two messages differ first."""

from __future__ import annotations

from typing import Any

import numpy as np

from schemas.base import Message, columns_of
from schemas.codec import decode
from schemas.contract import Topic


def first_difference(topic: Topic[Message], recorded: bytes, again: bytes) -> tuple[str, str]:
    """The first field that differs in two payloads of a topic, and how: ("path", "recorded 1, again 2").

    ("", "") when they say the same. Raises MessageError.
    """
    one, its = decode(recorded, topic.message, topic.max_bytes)
    other, others = decode(again, topic.message, topic.max_bytes)
    columns = columns_of(topic.message)
    found = _in_values(one.model_dump(exclude=set(columns)), other.model_dump(exclude=set(columns)), "")
    for name in columns:
        found = found or _in_arrays(name, getattr(one, name), getattr(other, name))
    return found or _in_values(dict(its.consumed), dict(others.consumed), "consumed") or ("", "")


def _in_values(one: Any, other: Any, path: str) -> tuple[str, str] | None:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(k for k in other if k not in one)]:
            inner = f"{path}.{key}" if path else str(key)
            found = _in_values(one.get(key), other.get(key), inner)
            if found:
                return found
        return None
    if isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            found = _in_values(a, b, f"{path}[{i}]")
            if found:
                return found
        return None
    return None if one == other else (path, f"recorded {_short(one)}, again {_short(other)}")


def _in_arrays(name: str, one: np.ndarray[Any, Any], other: np.ndarray[Any, Any]) -> tuple[str, str] | None:
    if one.shape != other.shape:
        return name, f"recorded shape {list(one.shape)}, again {list(other.shape)}"
    differs = np.argwhere(one != other)
    if not len(differs):
        return None
    at = tuple(int(i) for i in differs[0])
    place = ", ".join(map(str, at))
    return (
        f"{name}[{place}]",
        f"recorded {_short(one[at])}, again {_short(other[at])} ({len(differs)} elements differ)",
    )


def _short(value: Any) -> str:
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return text if len(text) <= 120 else text[:117] + "..."
