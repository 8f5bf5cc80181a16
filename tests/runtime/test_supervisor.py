"""The supervisor with fake services: starts, restarts, gives up, leaves nobody behind; and a whole mission's result."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest
from rich.console import Console
from typer.testing import CliRunner

from plgrim.cli import application
from plgrim.config import Config, write_config
from plgrim.errors import AlreadyRunningError, ConfigError, PortTakenError, ServiceFailedError
from plgrim.hosts import host_and_port
from plgrim.missions import run_live
from plgrim.runtime.process import THREAD_LIMITS, child_environment
from plgrim.runtime.router import check_endpoint_free
from plgrim.runtime.run_folder import refuse_unfinished, with_kept_state
from plgrim.runtime.supervisor import Supervisor, with_fresh_state
from schemas.base import Message
from schemas.codec import decode
from schemas.contract import Topic
from schemas.operation import MissionState
from schemas.topics import MISSION
from tests.runtime.helpers import FAKES, Start, eventually, fake_command

SERVICES = ("sim", "mission")


def _supervisor(config: Config, folder: Path, behaviours: dict[str, str] | None = None) -> Supervisor:
    return Supervisor(config, folder, SERVICES, fake_command(behaviours or {}))


def _pids(supervisor: Supervisor) -> list[int]:
    return [child.process.pid for child in supervisor.children.values() if child.process]


def _gone(pid: int) -> bool:
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_all_become_ready_and_all_end(config: Config, tmp_path: Path) -> None:
    waited: list[list[str]] = []
    with _supervisor(config, tmp_path) as supervisor:
        supervisor.start()
        assert supervisor.wait_ready(threading.Event(), waited.append)
        pids = _pids(supervisor)
        assert len(pids) == 3
    assert all(_gone(pid) for pid in pids)
    assert waited[-1] == []
    assert "ready" in (tmp_path / "logs" / "sim.log").read_text(encoding="utf-8")
    check_endpoint_free(config.router.endpoint)


def test_the_page_starts_when_all_that_drives_is_ready(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that resumes has two cores for nine processes; what it drives with has them first."""
    monkeypatch.setattr("plgrim.runtime.supervisor._LAST_AFTER_S", 1e6)
    services = ("status", "sim", "mission")
    with Supervisor(config, tmp_path, services, fake_command({"status": "idle"})) as supervisor:
        supervisor.start()
        status, sim = supervisor.children["status"], supervisor.children["sim"]
        assert [child.process is None for child in (status, sim)] == [True, False]
        assert supervisor.wait_ready(threading.Event())
        assert sim.ready_s is not None and status.started_s >= sim.ready_s
        assert status.process is not None
        os.kill(status.process.pid, signal.SIGKILL)
        eventually(
            lambda: status.restarted == 1 and status.ready, "it comes back like any other", supervisor.poll
        )


def test_a_killed_service_comes_back(config: Config, tmp_path: Path) -> None:
    with _supervisor(config, tmp_path) as supervisor:
        supervisor.start()
        supervisor.wait_ready(threading.Event())
        sim = supervisor.children["sim"]
        assert sim.process is not None
        killed = sim.process.pid
        os.kill(killed, signal.SIGKILL)

        def is_back() -> bool:
            return sim.process is not None and sim.process.pid != killed and sim.ready

        eventually(is_back, "the service is ready again", supervisor.poll)
        assert sim.restarted == 1


def _lives(heard: list[tuple[int, MissionState]]) -> int:
    """The lives that have said more than one thing."""
    counted = Counter(epoch for epoch, _ in list(heard))
    return sum(count > 1 for count in counted.values())


def test_a_killed_service_goes_on_with_what_it_had_said(config: Config, tmp_path: Path) -> None:
    """It counts on; its mission clock goes on; its epoch is a later one, so that readers take what it says."""
    heard: list[tuple[int, MissionState]] = []

    def receive(topic: Topic[Message], payload: bytes) -> None:
        message, envelope = decode(payload, topic.message, topic.max_bytes)
        assert isinstance(message, MissionState)
        heard.append((envelope.epoch, message))

    with _supervisor(config, tmp_path, {"mission": "remembers"}) as supervisor:
        link = supervisor.start()
        link.subscribe(MISSION, receive, every=True)
        supervisor.wait_ready(threading.Event())
        mission = supervisor.children["mission"]
        for life in range(3):
            eventually(lambda: _lives(heard) > life, f"it counts in life {life}", supervisor.poll)  # noqa: B023
            if life == 2:
                break
            killed = mission.process
            assert killed is not None
            os.kill(killed.pid, signal.SIGKILL)
            eventually(lambda: mission.process is not killed, "it is noticed", supervisor.poll)  # noqa: B023
        state = Path(supervisor.config.runtime.state_dir)
        assert state == tmp_path / "state"
        assert (state / "robot" / "mission.epoch").exists()
        supervisor.finished = True
    assert not state.exists()
    ordered = sorted(heard, key=lambda item: (item[0], item[1].stamp_ns))
    counts_heard = [message.distance_m for _, message in ordered]
    assert counts_heard == sorted(counts_heard)
    assert [m.stamp_ns for _, m in ordered] == sorted(m.stamp_ns for _, m in ordered)


def test_what_ran_well_is_restarted_at_once_and_what_keeps_failing_waits_longer(
    config: Config, tmp_path: Path
) -> None:
    supervisor = _supervisor(config, tmp_path)
    child, now = supervisor.children["sim"], 1000.0
    waits = []
    for ready_for_s in (None, 1.0, None, 60.0, None):
        child.ready_s = None if ready_for_s is None else now - ready_for_s
        child.restarts.clear()
        supervisor._ended(child, now)
        assert child.restart_at_s is not None
        waits.append(round((child.restart_at_s - now) / config.runtime.backoff_s, 6))
    assert waits == [1, 2, 4, 0, 1]


def test_each_run_begins_with_an_empty_state(config: Config, tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "old").write_text("of the last mission", encoding="ascii")
    own = with_fresh_state(config, tmp_path)
    assert own.runtime.state_dir == str(tmp_path / "state")
    assert not (tmp_path / "state" / "old").exists()
    runtime = config.runtime.model_copy(update={"state_dir": str(tmp_path / "mine")})
    named = with_fresh_state(config.model_copy(update={"runtime": runtime}), tmp_path)
    assert Path(named.runtime.state_dir).parent == tmp_path / "mine"


def test_the_state_of_a_mission_that_has_not_ended_is_kept(config: Config, tmp_path: Path) -> None:
    """A host is shut down, or somebody presses Ctrl-C; started again, it does not begin anew without being told."""
    with _supervisor(config, tmp_path, {"mission": "remembers"}) as supervisor:
        supervisor.start()
        supervisor.wait_ready(threading.Event())
        state = Path(supervisor.config.runtime.state_dir)
        with pytest.raises(AlreadyRunningError, match="a supervisor is at work"):
            refuse_unfinished(tmp_path)
    assert list(state.glob("robot/mission.*.sqlite"))
    with pytest.raises(ConfigError, match=rf"plgrim recover {tmp_path}.*--new"):
        refuse_unfinished(tmp_path)
    found = CliRunner().invoke(application, ["up", "--out", str(tmp_path)])
    assert isinstance(found.exception, ConfigError) and "--new" in str(found.exception)
    assert list(state.glob("robot/mission.*.sqlite"))
    assert with_kept_state(tmp_path).runtime.state_dir == str(state)


def test_a_folder_without_a_mission_is_free(config: Config, tmp_path: Path) -> None:
    refuse_unfinished(tmp_path / "new")
    write_config(with_fresh_state(config, tmp_path), tmp_path / "config.yaml")
    refuse_unfinished(tmp_path)
    (tmp_path / "config.yaml").write_text("of: another version", encoding="utf-8")
    refuse_unfinished(tmp_path)
    (tmp_path / "state" / "robot").mkdir(parents=True)
    (tmp_path / "state" / "robot" / "irm.a.sqlite").touch()
    with pytest.raises(ConfigError, match="has not ended"):
        refuse_unfinished(tmp_path)


def test_a_killed_router_comes_back_and_the_services_find_it(config: Config, tmp_path: Path) -> None:
    with _supervisor(config, tmp_path) as supervisor:
        supervisor.start()
        supervisor.wait_ready(threading.Event())
        router, sim = supervisor.children["router"], supervisor.children["sim"]
        assert router.process is not None
        os.kill(router.process.pid, signal.SIGKILL)
        eventually(lambda: router.restarted and router.process, "the router is back", supervisor.poll)
        steps = sim.health.steps if sim.health else 0

        def goes_on() -> bool:
            return sim.health is not None and sim.health.steps > steps + 20

        eventually(goes_on, "health comes through the new router", supervisor.poll)
        assert sim.restarted == 0


def test_a_stopped_router_is_replaced_and_no_service_with_it(config: Config, tmp_path: Path) -> None:
    with _supervisor(config, tmp_path) as supervisor:
        supervisor.start()
        supervisor.wait_ready(threading.Event())
        router, sim = supervisor.children["router"], supervisor.children["sim"]
        stopped = router.process
        assert stopped is not None
        eventually(
            lambda: supervisor.watch.silent_s("router", stopped.pid) > 0, "its pulse is seen", supervisor.poll
        )
        os.kill(stopped.pid, signal.SIGSTOP)
        eventually(lambda: router.process not in (None, stopped), "another router runs", supervisor.poll)
        steps = sim.health.steps if sim.health else 0

        def goes_on() -> bool:
            return sim.health is not None and sim.health.steps > steps + 20

        eventually(goes_on, "health comes through it", supervisor.poll)
        assert sim.restarted == 0


def test_a_supervisor_that_stood_still_blames_nobody(config: Config, tmp_path: Path) -> None:
    """It was stopped (SIGSTOP, a machine that hung) for longer than any service may be silent."""
    supervisor = _supervisor(config, tmp_path)
    with subprocess.Popen(["sleep", "600"], start_new_session=True) as sleeper:
        try:
            child = supervisor.children["sim"]
            child.process = sleeper
            silent_s = config.runtime.start_timeout_s + 60.0
            child.started_s = child.heard_s = supervisor._polled_s = time.monotonic() - silent_s
            supervisor.poll()
            assert sleeper.poll() is None
            child.started_s = child.heard_s = time.monotonic() - silent_s
            supervisor.poll()
            assert sleeper.wait(10.0) == -signal.SIGKILL
        finally:
            sleeper.kill()
            child.process = None
            supervisor.__exit__(None)


@pytest.mark.parametrize("behaviour", ["exits", "failing"])
def test_a_service_that_keeps_crashing_ends_the_run(config: Config, tmp_path: Path, behaviour: str) -> None:
    with _supervisor(config, tmp_path, {"mission": behaviour}) as supervisor:
        supervisor.start()

        with pytest.raises(ServiceFailedError, match=r"mission ended with .* after 2 restarts"):
            eventually(lambda: False, "the supervisor gives up", supervisor.poll)
        pids = _pids(supervisor)
    assert all(_gone(pid) for pid in pids)


def test_a_silent_service_is_killed_and_restarted(config: Config, tmp_path: Path) -> None:
    runtime = config.runtime.model_copy(update={"unresponsive_after_s": 1.0})
    config = config.model_copy(update={"runtime": runtime})
    with _supervisor(config, tmp_path) as supervisor:
        supervisor.start()
        supervisor.wait_ready(threading.Event())
        sim = supervisor.children["sim"]
        assert sim.process is not None
        os.kill(sim.process.pid, signal.SIGSTOP)
        eventually(lambda: sim.restarted == 1 and sim.ready, "it was replaced", supervisor.poll)


def test_a_second_instance_is_not_restarted_but_told(config: Config, tmp_path: Path) -> None:
    (tmp_path / "second").mkdir()
    with _supervisor(config, tmp_path) as supervisor:
        supervisor.start()
        supervisor.wait_ready(threading.Event())
        child = supervisor.children["sim"]
        first = child.process
        supervisor._spawn(child)

        eventually(supervisor.failed, "the second one is refused", supervisor.poll)
        assert "already running" in supervisor.failed()["sim"]
        assert child.restarted == 0
        child.process = first


def test_a_taken_port_is_named_with_the_mend(config: Config, tmp_path: Path) -> None:
    place = host_and_port(config.router.endpoint)
    assert place is not None
    with socket.create_server(place), _supervisor(config, tmp_path) as supervisor:
        with pytest.raises(PortTakenError, match=rf"port {place[1]} .*PLGRIM_ROUTER"):
            supervisor.start()
        assert _pids(supervisor) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_orphans_however_the_supervisor_ends(
    config: Config, tmp_path: Path, start: Start, number: signal.Signals
) -> None:
    process = start(str(FAKES.with_name("fake_supervisor.py")), str(tmp_path))
    pids = tmp_path / "pids.json"
    eventually(lambda: pids.exists() or process.poll() is not None, "the children are ready")
    children = json.loads(pids.read_text(encoding="utf-8"))
    assert len(children) == 3
    assert not any(_gone(pid) for pid in children)
    process.send_signal(number)
    process.wait(timeout=60)
    eventually(lambda: all(_gone(pid) for pid in children), "no child is left")


def test_a_mission_to_its_end_gives_a_result(config: Config, tmp_path: Path) -> None:
    result = run_live(
        config,
        tmp_path,
        threading.Event(),
        Console(quiet=True),
        services=SERVICES,
        command=fake_command({"mission": "ends"}),
    )
    assert result["succeeded"] is True
    assert result["finish"] == "covered"
    assert result["coverage_judge"] == 0.99
    assert result["stages"]["sim"]["steps"] > 10
    assert result["stages"]["mission"]["errors"] == 0
    for name in ("result.json", "trajectory.csv", "coverage.png", "map.png", "config.yaml"):
        assert (tmp_path / name).stat().st_size > 0
    assert json.loads((tmp_path / "result.json").read_text(encoding="utf-8")) == result
    assert not (tmp_path / "state").exists(), "nobody goes on with a mission that has ended"


def test_a_stop_before_the_end_gives_a_result_that_says_so(config: Config, tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    result = run_live(
        config, tmp_path, stop, Console(quiet=True), services=SERVICES, command=fake_command({})
    )
    assert result["succeeded"] is False
    assert result["finish"] == ""
    assert (tmp_path / "result.json").exists()


def test_children_compute_on_one_thread_and_know_their_parent() -> None:
    environment = child_environment({"PATH": "/bin", "OMP_NUM_THREADS": "3"})
    assert environment["PLGRIM_PARENT_PID"] == str(os.getpid())
    assert environment["NUMBA_NUM_THREADS"] == THREAD_LIMITS["NUMBA_NUM_THREADS"] == "1"
    assert environment["OMP_NUM_THREADS"] == "3"
