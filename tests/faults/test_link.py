"""The link between robot and base under stress: real processes on two hosts, a slow link, cuts, losses.

The services are fakes (`tests/link/fakes.py`); routers and link process are the real ones. Margins are stated with each
figure; the figures are printed.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from plgrim.deployment import Role, processes_of
from plgrim.security.access import ROUTER, certificate_name
from plgrim.security.certificates import Authority
from tests.faults.network import BASE, BASE_ADDRESS, ROBOT, Network, cut_off, require_network

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

SECURED_ROBOT = "husky1"
FAKES = ("-m", "tests.link.fakes")
ROBOT_TOPICS = "gcp/global_policy,sim/odometry,irm/global_irm,riskmap/risk_map,link/report,status/command"
BASE_TOPICS = (
    "gcp/global_policy,mission/state,sim/health,mission/health,irm/global_irm,riskmap/risk_map,link/report"
)


class Line:
    """One message that an observer wrote down. at_s: monotonic; latency_s: since it was sent."""

    def __init__(self, fields: list[Any]) -> None:
        at_ns, self.topic, self.epoch, self.sequence, sent_ns, self.more = fields
        self.at_s = at_ns / 1e9
        self.latency_s = (at_ns - sent_ns) / 1e9


def lines(path: Path, topic: str = "") -> list[Line]:
    """What an observer has written so far, of one topic or of all; a last line that is not whole is left."""
    text = path.read_text(encoding="ascii") if path.exists() else ""
    found = [Line(json.loads(line)) for line in text.splitlines(keepends=True) if line.endswith("\n")]
    return [line for line in found if not topic or line.topic == topic]


def quantile(values: list[float], share: float) -> float:
    """The value at a share of the sorted values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def gaps(found: list[Line]) -> list[float]:
    """Seconds between messages that follow one another."""
    return [b.at_s - a.at_s for a, b in pairwise(found)]


class Site:
    """Robot and base with their routers, the link process, fakes and observers.

    certificates: folders by role (`certificates_by_role`): then both hosts speak mutual TLS alone, with access control,
    also within themselves; without them plain TCP.
    """

    def __init__(
        self,
        network: Network,
        folder: Path,
        link: dict[str, str] | None = None,
        certificates: dict[Role, Path] | None = None,
    ) -> None:
        self.network = network
        self.robot_file, self.base_file = folder / "robot.jsonl", folder / "base.jsonl"
        protocol = "tls" if certificates else "tcp"
        base = f"{protocol}/{network.address(BASE)}:7447"
        shared = {
            "PLGRIM_RUNTIME__ROUTER_TIMEOUT_S": "60",
            "PLGRIM_LINK__ENDPOINT": base,
            **{f"PLGRIM_LINK__{name}": value for name, value in (link or {}).items()},
        }
        self._environment = {
            ROBOT: {**shared, "PLGRIM_LINK__HOST": ROBOT, "PLGRIM_ROUTER": f"{protocol}/127.0.0.1:7457"},
            BASE: {**shared, "PLGRIM_LINK__HOST": BASE, "PLGRIM_ROUTER": base},
        }
        for host, environment in self._environment.items():
            if certificates:
                environment["PLGRIM_ROBOT"] = SECURED_ROBOT
                environment["PLGRIM_ROUTER__CERTIFICATES"] = str(
                    certificates["robot" if host == ROBOT else "base"]
                )
            else:
                environment["PLGRIM_DEPLOYMENT__PUBLISHED_ON"] = (
                    "none"  # two namespaces and a cable between them
                )

    def start(self, host: str, *names: str) -> None:
        """Start fakes in a process of their own."""
        self.network.start(host, self._environment[host], *FAKES, *names)

    def begin(self, robot: tuple[str, ...], base: tuple[str, ...]) -> None:
        """Start all, and wait until the base is obeyed."""
        self.start(ROBOT, "router")
        self.start(BASE, "router")
        self.start(ROBOT, "link")
        self.start(ROBOT, *robot, f"observe:{self.robot_file}:{ROBOT_TOPICS}")
        self.start(BASE, *base, f"observe:{self.base_file}:{BASE_TOPICS}")
        self.wait(lambda: self.holder() == "base", "the base was given the lease", 90.0)

    def holder(self) -> str:
        """Who is obeyed, by the last report."""
        reports = lines(self.robot_file, "link/report")
        return str(reports[-1].more["holder"]["gcp"]) if reports else ""

    def wait(self, condition: Callable[[], bool], what: str, within_s: float) -> float:
        """Seconds until a condition held."""
        began = time.monotonic()
        while not condition():
            assert time.monotonic() - began < within_s, f"never happened: {what}"
            time.sleep(0.05)
        return time.monotonic() - began


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    """Two hosts and a link between them."""
    require_network()
    with Network(tmp_path) as made:
        yield made


@pytest.mark.parametrize("maps_kb_per_s", ["120", "10000"], ids=["budget", "overload"])
def test_maps_do_not_delay_commands_and_heartbeats(
    network: Network, tmp_path: Path, maps_kb_per_s: str
) -> None:
    """2 Mbit/s, maps of 100 kB at 4 Hz: p95 below 0.3 s, none lost, within the budget of maps and without any."""
    network.rate(2.0)
    topics = json.dumps({"riskmap/risk_map": float(maps_kb_per_s)})
    site = Site(network, tmp_path, {"MAPS_KB_PER_S": maps_kb_per_s, "TOPIC_KB_PER_S": topics})
    site.begin(("sim", "irm", "mission", "gcp", "riskmap"), ("gcp", "status"))
    began = time.monotonic()
    time.sleep(20.0)
    ended = time.monotonic() - 1.0

    def during(path: Path, topic: str) -> list[Line]:
        return [line for line in lines(path, topic) if began < line.at_s < ended]

    bad = []
    for path, topic in (
        (site.robot_file, "status/command"),
        (site.base_file, "sim/health"),
        (site.base_file, "mission/health"),
        (site.base_file, "mission/state"),
    ):
        heard = during(path, topic)
        missing = heard[-1].sequence - heard[0].sequence + 1 - len(heard)
        p95 = quantile([line.latency_s for line in heard], 0.95)
        print(f"{topic}: {len(heard)} heard, {missing} lost, p95 {p95:.3f} s")
        bad += [topic] if missing or p95 >= 0.3 else []
    maps = during(site.base_file, "riskmap/risk_map")
    report = lines(site.base_file, "link/report")[-1].more
    print(
        f"maps: {len(maps)}, p95 {quantile([m.latency_s for m in maps], 0.95):.2f} s; {report['down_kb_per_s']}"
    )
    assert not bad
    assert len(maps) > 5
    if maps_kb_per_s == "120":
        assert (
            60.0 < report["down_kb_per_s"]["riskmap/risk_map"] < 120.0 * 1.2 + 20.0
        )  # one map in 5 s: 20 kB/s


@pytest.fixture
def certificates(tmp_path: Path) -> dict[Role, Path]:
    """Of both hosts; the routers are known by their addresses."""
    authority = Authority.create(tmp_path / "ca")
    folders: dict[Role, Path] = {"robot": tmp_path / "certs-robot", "base": tmp_path / "certs-base"}
    for role, folder in folders.items():
        for process in processes_of(role):
            hosts = ("127.0.0.1", BASE_ADDRESS) if process == ROUTER else ()
            authority.issue(certificate_name(process, role, SECURED_ROBOT), folder / process, hosts)
    for folder in folders.values():
        authority.trust(folder)
    return folders


@pytest.mark.parametrize(
    ("loss", "secured"), [(0.0, False), (0.15, False), (0.0, True)], ids=["clean", "lossy", "secured"]
)
def test_a_cut_is_survived_and_mended(
    network: Network, tmp_path: Path, loss: float, secured: bool, certificates: dict[Role, Path]
) -> None:
    """A cut of 10 s: no local gap, takeover within 5 s, nothing stale, one graph within 5 s (15 s with loss).

    secured: over mutual TLS, each process with its own certificate and no more than the table of topics allows it.
    There the lane of maps was seen to come back some 5 s later than over TCP, hence the graph and the lease: 15 s, too.
    """
    network.rate(10.0)
    if loss:
        network.lose(loss)
    site = Site(network, tmp_path, certificates=certificates if secured else None)
    site.begin(("sim", "irm", "mission", "gcp", "riskmap"), ("gcp", "status"))
    time.sleep(11.0)  # a lease that is lost sooner is given back later
    cut_s = time.monotonic()
    with cut_off(network):
        site.wait(lambda: site.holder() == "standby", "the standby took over", 20.0)
        time.sleep(max(0.0, 10.0 - (time.monotonic() - cut_s)))
    joined_s = time.monotonic()
    limit_s = 15.0 if loss or secured else 5.0

    def graph_is_there() -> bool:
        here, there = lines(site.robot_file, "irm/global_irm"), lines(site.base_file, "irm/global_irm")
        return bool(there[-1].at_s > joined_s) and here[-1].sequence - there[-1].sequence <= 2

    graph_s = site.wait(graph_is_there, "the base had the newest graph", 60.0)
    took_s = graph_s + site.wait(lambda: site.holder() == "base", "the base was obeyed again", 60.0)
    time.sleep(2.0)
    policies = lines(site.robot_file, "gcp/global_policy")
    graphs = {line.more[0] if line.more else 0 for line in policies}
    assert graphs
    after_cut = [line for line in policies if line.at_s > cut_s]
    takeover_s = next(line.at_s for line in after_cut if line.epoch > policies[0].epoch) - cut_s
    odometry = [line for line in lines(site.robot_file, "sim/odometry") if line.at_s > cut_s - 2.0]
    policy_gap, local_gap = max(gaps([p for p in policies if p.at_s > cut_s - 2.0])), max(gaps(odometry))
    print(
        f"loss {loss}: first policy of the standby {takeover_s:.2f} s after the cut, largest gap of policies "
        f"{policy_gap:.2f} s, of local odometry (20 Hz) {local_gap:.3f} s; the graph {graph_s:.2f} s, "
        f"the lease {took_s:.2f} s after the return"
    )
    assert takeover_s < 5.0
    assert policy_gap < 5.0
    assert (
        local_gap < 1.0
    )  # nothing on the robot waits for the link; the machine itself may stall for a moment
    assert took_s < limit_s
    assert_never_stale(policies, lines(site.robot_file, "irm/global_irm"))


def assert_never_stale(policies: list[Line], graphs: list[Line]) -> None:
    """Epochs and sequences only grow, and no policy was made from a graph that had been replaced for over 4 s."""
    marks = [(line.epoch, line.sequence) for line in policies]
    assert marks == sorted(set(marks))
    came = [line.at_s for line in graphs]  # the fake's graph of version n is its nth message
    offset = graphs[0].sequence
    for policy in policies:
        after = policy.more[0] + 1 - offset
        if 0 <= after < len(came):
            assert policy.at_s - came[after] < 4.0, f"policy {policy.sequence} from graph {policy.more[0]}"
