"""The machine: cores, memory, disk, clock, compiled kernels, ports."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import psutil

from plgrim.config import Config
from plgrim.doctor.finding import Finding
from plgrim.errors import PlgrimError
from plgrim.runtime.router import check_port_free

_CORES, _MEMORY_GB, _DISK_GB = 2, 2.0, 1.0
_SANE_S = 1_700_000_000
"""A wall clock before this (2023) was never set: certificates seem not yet valid, epochs run backwards."""
_LOAD = 1.5


def cores() -> Finding:
    """Whether there are enough, and whether others keep them busy."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    if usable < _CORES:
        return Finding(
            "cores", "warning", f"{usable}, the services want {_CORES}", "use --speed below 1, or --lockstep"
        )
    load = os.getloadavg()[0] / usable
    if load > _LOAD:
        return Finding(
            "cores",
            "warning",
            f"{usable}, and {load:.1f} processes wait for each",
            "stop what else runs here",
        )
    return Finding("cores", "ok", f"{usable}, load {load:.2f} for each")


def memory() -> Finding:
    """Whether enough is free for all services (about 250 MB each)."""
    free_gb = psutil.virtual_memory().available / 1e9
    if free_gb < _MEMORY_GB:
        mend = "stop other programs, or run fewer services on this host"
        return Finding(
            "memory", "error", f"{free_gb:.1f} GB free, the services take about {_MEMORY_GB} GB", mend
        )
    return Finding("memory", "ok", f"{free_gb:.1f} GB free")


def disk(config: Config) -> Finding:
    """Whether journals and results have room, and whether their folder can be written."""
    folder = Path(config.runtime.state_dir or ".").resolve()
    while not folder.exists():
        folder = folder.parent
    free_gb = shutil.disk_usage(folder).free / 1e9
    if not os.access(folder, os.W_OK):
        mend = "choose another folder with runtime.state_dir or --out, or make it writable"
        return Finding("disk", "error", f"{folder} cannot be written", mend)
    if free_gb < _DISK_GB:
        mend = "make room: journals and recordings stop when the disk is full, the robot goes on degraded"
        return Finding("disk", "error", f"{free_gb:.2f} GB free in {folder}", mend)
    return Finding("disk", "ok", f"{free_gb:.0f} GB free in {folder}")


def clock(config: Config) -> Finding:
    """Whether the wall clock was ever set, and whether the mission clock can be shared as configured."""
    if time.time() < _SANE_S:
        mend = "set the clock (timedatectl set-ntp true): certificates and epochs hang on it"
        return Finding("clock", "error", f"the wall clock says {time.strftime('%Y-%m-%d')}", mend)
    if config.clock.source == "realtime" and not _synchronised():
        mend = "start chrony or systemd-timesyncd: with clock.source realtime several hosts must agree"
        return Finding(
            "clock", "warning", "clock.source is realtime, and no time service has synchronised", mend
        )
    return Finding(
        "clock", "ok", f"{config.clock.source}, wall clock {time.strftime('%Y-%m-%d %H:%M:%S %z')}"
    )


def _synchronised() -> bool:
    """Whether the kernel or a time service says so (Linux)."""
    if Path("/run/systemd/timesync/synchronized").exists():
        return True
    try:
        import ctypes

        buffer = ctypes.create_string_buffer(512)  # struct timex, modes 0: only asks
        return int(ctypes.CDLL(None).adjtimex(buffer)) != 5  # TIME_ERROR: not synchronised
    except (OSError, AttributeError):
        return False


def kernels() -> Finding:
    """Whether the compiled kernels of these sources are in the cache."""
    from planning.kernels import cache_directory

    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_directory())
    parent = folder
    while not parent.exists():
        parent = parent.parent
    if not os.access(parent, os.W_OK):
        mend = "set PLGRIM_CACHE_DIR to a folder that can be written: without it every start compiles for minutes"
        return Finding("kernel cache", "error", f"{parent} cannot be written", mend)
    count = sum(1 for _ in folder.rglob("*.nbi")) if folder.exists() else 0
    if not count:
        mend = "python -m plgrim.warmup (make env does it): else the first start compiles for minutes"
        return Finding("kernel cache", "warning", f"nothing is compiled in {folder}", mend)
    return Finding("kernel cache", "ok", f"{count} kernels in {folder}")


def port(name: str, host: str, number: int, in_use_by: str, key: str) -> Finding:
    """Whether a port is free, or taken by who should have it. in_use_by: empty when that one does not answer."""
    if in_use_by:
        return Finding(name, "ok", f"{host}:{number}, {in_use_by}")
    try:
        check_port_free(host, number, f"choose another with {key}")
    except PlgrimError as error:
        says, _, mend = str(error).partition(": ")
        return Finding(name, "error", says, mend)
    return Finding(name, "ok", f"{host}:{number} is free")
