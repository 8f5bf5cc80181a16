"""What the payloads of the raw channels hold, as JSON: the attachment `schemas.json` of every recording."""

from __future__ import annotations

from functools import cache
from typing import Any

from schemas.base import Message, columns_of
from schemas.topics import SERVICES, TOPICS, health_topic, recorder_topics


@cache
def describe_schemas() -> dict[str, Any]:
    """By schema name: version, topics, header fields with type and meaning, and columns with type and shape."""
    topics = [*TOPICS, *(t for s in SERVICES for t in (health_topic(s), *recorder_topics(s)))]
    found: dict[str, Any] = {}
    for topic in topics:
        message = topic.message
        entry = found.setdefault(message.schema_name, _describe(message))
        entry["topics"].append(topic.name)
    return {
        "payload": "msgpack [xxh3-64 of all after the first 10 bytes, {schema, version, robot, writer, epoch, "
        "sequence, sent_ns, consumed, header, columns}]; a column is [dtype, shape, little-endian bytes]",
        "schemas": dict(sorted(found.items())),
    }


def _describe(message: type[Message]) -> dict[str, Any]:
    columns = columns_of(message)
    fields = {
        name: {
            "type": str(info.annotation).replace("<class '", "").replace("'>", ""),
            "says": info.description or "",
        }
        for name, info in message.model_fields.items()
        if name not in columns
    }
    return {
        "version": message.schema_version,
        "says": (message.__doc__ or "").strip(),
        "topics": [],
        "header": fields,
        "columns": {name: {"dtype": spec.dtype, "shape": list(spec.shape)} for name, spec in columns.items()},
    }
