"""Reads recordings: the raw messages in the order in which they were recorded, also of files that are cut off."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.records import Channel, Metadata
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader

from plgrim.recording.envelope import RAW_PREFIX, Raw, unpack_raw
from plgrim.recording.errors import RecordingError
from plgrim.recording.writer import segments

Warn = Callable[[str], None]
_LARGEST = 512 * 1024 * 1024


def read_raw(path: Path, warn: Warn, wanted: Callable[[str], bool] = lambda topic: True) -> Iterator[Raw]:
    """The raw messages of a file or of a folder of segments, in recorded order.

    wanted: whether a topic is asked for; others are not unpacked. warn: told of what is cut off. Raises RecordingError.
    """
    files = segments(path)
    if not path.exists() or not files:
        raise RecordingError(
            f"{path}: no recording there: name an .mcap file, or a folder that `plgrim record` wrote"
        )
    found = False
    for file in files:
        try:
            for raw in _read_file(file, warn, wanted):
                found = True
                yield raw
        except RecordingError as error:  # one segment of many
            if not path.is_dir():
                raise
            warn(str(error))
    if not found:
        raise RecordingError(
            f"{path}: holds no PLGRIM messages (topics {RAW_PREFIX}...): `plgrim record` writes them; "
            "for recordings of a robot's sensors there is `plgrim feed`"
        )


def _read_file(path: Path, warn: Warn, wanted: Callable[[str], bool]) -> Iterator[Raw]:
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, record_size_limit=_LARGEST).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Record):
                    topic = topics.get(record.channel_id, "")
                    if topic.startswith(RAW_PREFIX) and wanted(topic.removeprefix(RAW_PREFIX)):
                        yield unpack_raw(record.data)
        except Exception as error:  # whatever a damaged file makes of the library
            if not topics:
                raise RecordingError(f"{path}: not an MCAP file: {type(error).__name__} {error}") from error
            warn(f"{path}: cut off or damaged, read up to there ({type(error).__name__})")


def read_about(path: Path) -> dict[str, str]:
    """The metadata of a recording; empty when it has none."""
    for file in segments(path):
        with file.open("rb") as stream:
            try:
                for record in StreamReader(stream, record_size_limit=_LARGEST).records:
                    if isinstance(record, Metadata) and record.name == "plgrim":
                        return dict(record.metadata)
                    if isinstance(record, Record):
                        break
            except Exception:  # as above; the next segment may be whole
                continue
    return {}
