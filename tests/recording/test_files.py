"""Recordings as files: other libraries open them, what was on the wire comes back, the ring keeps its bound."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from plgrim.recording import writer
from plgrim.recording.describe import describe_schemas
from plgrim.recording.envelope import Raw
from plgrim.recording.errors import RecordingError
from plgrim.recording.reader import read_about, read_raw
from plgrim.recording.writer import Ring, segments
from schemas.codec import decode
from schemas.sensing import Odometry
from tests.recording.conftest import Short


def _fail(text: str) -> None:
    raise AssertionError(text)


def _raw(sequence: int, size: int = 100) -> Raw:
    noise = np.random.default_rng(sequence).integers(0, 256, size, np.uint8).tobytes()
    return Raw("sim/odometry", "odometry", 1, "sim", 1, sequence, sequence * 1000, noise)


def test_the_mcap_library_decodes_every_channel(short: Short) -> None:
    (path,) = segments(short.folder)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        decoded = {channel.topic for _, channel, _, _ in reader.iter_decoded_messages()}
        assert decoded == {channel.topic for channel in summary.channels.values()}
        assert all(index.compression == "zstd" for index in summary.chunk_indexes)
        assert [a.name for a in reader.iter_attachments()] == ["schemas.json"]
    assert {"/tf", "/plgrim/odometry", "/plgrim/risk", "/plgrim/plan", "/plgrim/global_irm"} <= decoded


def test_rosbags_decodes_every_channel_and_sees_the_same_numbers(short: Short) -> None:
    (path,) = segments(short.folder)
    seen: dict[str, int] = {}
    odometry: list[float] = []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            seen[connection.topic] = seen.get(connection.topic, 0) + 1
            if connection.topic == "/plgrim/odometry":
                odometry.append(message.pose.pose.position.x)
        assert set(seen) == {connection.topic for connection in reader.connections}
    ours = [decode(r.payload, Odometry, 1 << 20)[0] for r in short.raws if r.schema == "odometry"]
    assert odometry == [message.pose.x_m for message in ours]
    assert seen["/plgrim/cloud"] < seen["/plgrim/raw/sim/cloud"]


def test_what_was_on_the_wire_comes_back_byte_for_byte(short: Short) -> None:
    assert list(read_raw(short.folder, _fail)) == short.raws
    assert read_about(short.folder)["world"] == "subway_1x"


def test_the_attachment_describes_every_schema_that_is_recorded(short: Short) -> None:
    described = describe_schemas()["schemas"]
    assert {raw.schema for raw in short.raws} <= set(described)
    assert described["odometry"]["columns"]["covariance"] == {"dtype": "float64", "shape": [3, 3]}


def test_a_file_that_is_cut_off_is_read_up_to_there(short: Short, tmp_path: Path) -> None:
    (path,) = segments(short.folder)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    warnings: list[str] = []
    found = list(read_raw(cut, warnings.append))
    assert 0 < len(found) < len(short.raws)
    assert found == short.raws[: len(found)]
    assert len(warnings) == 1


@pytest.mark.parametrize(
    ("content", "text"), [(None, "no recording there"), (b"nonsense" * 9, "not an MCAP file")]
)
def test_what_is_no_recording_is_an_error_with_its_name(
    tmp_path: Path, content: bytes | None, text: str
) -> None:
    path = tmp_path / "x.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=text):
        list(read_raw(path, lambda _: None))


def test_the_ring_keeps_its_bound_and_loses_the_oldest(tmp_path: Path) -> None:
    now = [0.0]
    ring = Ring(tmp_path, {}, segment_s=1.0, max_bytes=400_000, clock=lambda: now[0])
    for sequence in range(1, 101):
        ring.add(_raw(sequence, 20_000), [], sequence)
        now[0] += 0.25
    ring.close()
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 400_000
    kept = [raw.sequence for raw in read_raw(tmp_path, _fail)]
    assert kept == list(range(kept[0], 101))
    assert 1 < kept[0] <= 100 - 8


def test_a_ring_goes_on_after_its_process_died(tmp_path: Path) -> None:
    first = Ring(tmp_path, {})
    for sequence in range(1, 200):
        first.add(_raw(sequence, 20_000), [], sequence)  # and dies: never closed
    assert first._writer is not None
    first._writer._file.close()
    second = Ring(tmp_path, {})
    second.add(_raw(1000), [], 1)
    second.close()
    found = [raw.sequence for raw in read_raw(tmp_path, lambda _: None)]
    assert found[-1] == 1000
    assert found[:-1] == list(range(1, len(found)))
    assert len(found) > 100  # all but the last chunk


def test_a_full_disk_loses_messages_and_says_so_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, full = [0.0], [True]
    ring = Ring(tmp_path, {}, clock=lambda: now[0])
    write = writer.SegmentWriter._add

    def add(self: writer.SegmentWriter, *arguments: object) -> None:
        if full[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(writer.SegmentWriter, "_add", add)
    ring.add(_raw(1), [], 1)
    assert "No space" in ring.trouble
    ring.add(_raw(2), [], 2)
    full[0], now[0] = False, 60.0
    ring.add(_raw(3), [], 3)
    ring.close()
    assert ring.trouble == ""
    assert ring.lost >= 1
    assert [raw.sequence for raw in read_raw(tmp_path, lambda _: None)] == [3]
