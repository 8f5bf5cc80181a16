"""What a disk may hold after a power cut: the writes of a process, recorded call by call, replayed up to any of them.

`record` runs a program under `disk_shim.c`. `Disk` takes its calls one by one and gives the folders that a cut at that
moment may leave, as strictly as POSIX has it: what was not followed by fsync may be there, be missing, or be torn at a
sector; a name that was made, replaced or removed counts as safe only after an fsync of its folder.
"""

from __future__ import annotations

import os
import random
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

_HEAD = struct.Struct("<cIIq")
_SECTOR = 512
SHIM = Path(__file__).with_name("disk_shim.c")
WRITER = Path(__file__).with_name("disk_writer.py")


@dataclass(frozen=True, slots=True)
class Call:
    """kind: create, mkdir (m), write, truncate, sync, rename, unlink, acknowledge. offset: of a write; a size."""

    kind: str
    path: str
    data: bytes
    offset: int


def build_shim(folder: Path) -> Path | None:
    """The compiled shim, or None without a C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or sys.platform != "linux":
        return None
    library = folder / "disk_shim.so"
    command = [compiler, "-O1", "-shared", "-fPIC", "-o", str(library), str(SHIM), "-ldl", "-lpthread"]
    subprocess.run(command, check=True)
    return library


def run_writer(
    shim: Path, folder: Path, generations: int, records: int, **faults: int
) -> tuple[list[Call], str]:
    """The calls of `disk_writer.py` in `folder/state`, and what it printed. faults: DISK_FAIL_AT and so on."""
    log, acks = folder / "log", folder / "acks"
    environment = {
        **os.environ,
        "LD_PRELOAD": str(shim),
        "DISK_ROOT": str(folder / "state"),
        "DISK_LOG": str(log),
        "DISK_ACKS": str(acks),
        **{name: str(value) for name, value in faults.items()},
    }
    command = [sys.executable, str(WRITER), str(folder / "state"), str(acks), str(generations), str(records)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return list(_parse(log.read_bytes())), done.stdout


def _parse(content: bytes) -> Iterator[Call]:
    at = 0
    while at < len(content):
        kind, length, size, offset = _HEAD.unpack_from(content, at)
        at += _HEAD.size
        path, data = content[at : at + length].decode(), content[at + length : at + length + size]
        at += length + size
        yield Call(kind.decode(), path, data, offset)


@dataclass(slots=True)
class _File:
    """safe: content at the last fsync. pending: writes (offset, bytes) and truncates (size, None) since then."""

    safe: bytes = b""
    pending: list[tuple[int, bytes | None]] = field(default_factory=list)


@dataclass(slots=True)
class Disk:
    """Takes calls; `images` are what a cut now may leave. Names map to a file, or to None for a folder."""

    root: str
    acknowledged: list[str] = field(default_factory=list)
    _names: dict[str, _File | None] = field(default_factory=dict)
    _safe_names: dict[str, _File | None] = field(default_factory=dict)
    _moves: list[tuple[str, _File | None, bool]] = field(default_factory=list)

    def take(self, call: Call) -> None:
        """One call more."""
        match call.kind:
            case "a":
                self.acknowledged += call.data.decode().split("\n")[:-1]
            case "c" | "m":
                self._name(call.path, _File() if call.kind == "c" else None, True)
            case "w":
                self._file(call.path).pending.append((call.offset, call.data))
            case "t":
                self._file(call.path).pending.append((call.offset, None))
            case "r":
                self._name(call.data.decode(), self._names[call.path], True)
                self._name(call.path, None, False)
            case "u":
                self._name(call.path, None, False)
            case "s":
                self._sync(call.path)

    def _file(self, path: str) -> _File:
        found = self._names[path]
        assert found is not None, path
        return found

    def _name(self, path: str, file: _File | None, there: bool) -> None:
        _apply(self._names, (path, file, there))
        self._moves.append((path, file, there))

    def _sync(self, path: str) -> None:
        file = self._names.get(path)
        if file is not None:
            file.safe, file.pending = _content(file, file.pending), []
            return
        for move in [m for m in self._moves if os.path.dirname(m[0]) == path]:
            _apply(self._safe_names, move)
            self._moves.remove(move)

    def write_image(self, target: Path, moves: int, rng: random.Random | None) -> None:
        """One of the folders that a cut now may leave, under `target`.

        moves: how many of the unsafe changes of names came to be. rng: which of the unsafe writes came to be, and how
        much of the last of them; None: all.
        """
        names = dict(self._safe_names)
        for move in self._moves[:moves]:
            _apply(names, move)
        for path, file in sorted(names.items()):
            place = target / os.path.relpath(path, self.root)
            if not _is_reachable(path, names, self.root):
                continue
            if file is None:
                place.mkdir(parents=True, exist_ok=True)
            else:
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(_content(file, _chosen(file.pending, rng)))

    def images(self, target: Path, seeds: range) -> Iterator[Path]:
        """Folders: all came to be; nothing unsafe did; all names but no unsafe bytes; random parts, one a seed."""
        nothing = _Never()
        cases: list[tuple[int, random.Random | None]] = [
            (len(self._moves), None),
            (0, nothing),
            (len(self._moves), nothing),
        ]
        for seed in seeds:
            chance = random.Random(seed)
            cases.append((chance.randint(0, len(self._moves)), chance))
        for number, (moves, rng) in enumerate(cases):
            folder = target / str(number)
            folder.mkdir(parents=True)
            self.write_image(folder, moves, rng)
            yield folder
            shutil.rmtree(folder)


class _Never(random.Random):
    """Chooses nothing."""

    def random(self) -> float:
        return 1.0


def _apply(names: dict[str, _File | None], move: tuple[str, _File | None, bool]) -> None:
    path, file, there = move
    if there:
        names[path] = file
    else:
        names.pop(path, None)


def _is_reachable(path: str, names: dict[str, _File | None], root: str) -> bool:
    """Whether all folders above it are there."""
    parent = os.path.dirname(path)
    while len(parent) > len(root):
        if parent not in names:
            return False
        parent = os.path.dirname(parent)
    return True


def _content(file: _File, writes: list[tuple[int, bytes | None]]) -> bytes:
    content = bytearray(file.safe)
    for offset, data in writes:
        if data is None:
            content = content[:offset].ljust(offset, b"\0")
        else:
            content = content.ljust(offset, b"\0")
            content[offset : offset + len(data)] = data
    return bytes(content)


def _chosen(
    pending: list[tuple[int, bytes | None]], rng: random.Random | None
) -> list[tuple[int, bytes | None]]:
    """Some of the writes, in any subset, the last of them torn at a sector."""
    if rng is None:
        return pending
    found = [write for write in pending if rng.random() < 0.5]
    if found and found[-1][1] and rng.random() < 0.5:
        offset, data = found[-1]
        assert data is not None
        found[-1] = (offset, data[: _SECTOR * rng.randint(0, len(data) // _SECTOR)])
    return found
