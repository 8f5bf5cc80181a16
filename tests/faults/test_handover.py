"""What the observer of the fault suite says of a restarted irm, with graphs made for the purpose: nothing is killed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from planning.graph_mirror import GraphMirror
from schemas.base import Pose
from schemas.world import BREADCRUMB, GlobalIrm
from tests.faults.observer import compare


def graph(version: int, nodes: Sequence[int], base_version: int = 0) -> GlobalIrm:
    """Breadcrumbs with these ids in a row, each joined to the next."""
    count, edges = len(nodes), max(len(nodes) - 1, 0)
    xyz_m = np.zeros((count, 3))
    xyz_m[:, 0] = nodes
    return GlobalIrm(
        stamp_ns=0,
        irm_version=version,
        base_version=base_version,
        robot_pose=Pose(),
        map_to_odom=Pose(),
        robot_node=nodes[-1],
        node_id=np.array(nodes, np.int64),
        node_kind=np.full(count, BREADCRUMB, np.uint8),
        node_xyz_m=xyz_m,
        node_gain=np.zeros(count),
        node_coverage=np.zeros(count, np.float32),
        edge_a=np.array(nodes[:-1], np.int64),
        edge_b=np.array(nodes[1:], np.int64),
        edge_distance_m=np.ones(edges),
        edge_risk=np.zeros(edges),
        edge_driven=np.ones(edges, np.uint8),
        removed_node=np.zeros(0, np.int64),
        removed_edge=np.zeros((0, 2), np.int64),
    )


@pytest.fixture
def acknowledged() -> GraphMirror:
    """Five nodes, as of version 12."""
    held = GraphMirror()
    assert held.apply(graph(12, [1, 2, 3, 4, 5]))
    return held


def test_the_same_graph_as_the_next_version_is_no_fault(acknowledged: GraphMirror) -> None:
    assert compare(acknowledged, graph(13, [1, 2, 3, 4, 5])).faults() == []


def test_what_is_missing_from_the_next_version_is_lost(acknowledged: GraphMirror) -> None:
    handover = compare(acknowledged, graph(13, [1, 2, 3, 4]))
    assert (handover.lost_nodes, handover.lost_edges) == (1, 1)
    (fault,) = handover.faults()
    assert "acknowledged and lost" in fault


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_a_journal_that_lost_its_last_records_shows_in_the_version_too(
    acknowledged: GraphMirror, lost: int
) -> None:
    """It restores version 12 - lost and says the one after it: a number that was given before."""
    handover = compare(acknowledged, graph(13 - lost, [1, 2, 3, 4]))
    assert handover.version_step == 1 - lost
    assert [fault.split(":")[0] for fault in handover.faults()] == [
        "acknowledged and lost",
        "the journal lost its last records, a version was given twice",
    ]


def test_a_version_given_twice_is_a_fault_though_nothing_is_missing(acknowledged: GraphMirror) -> None:
    (fault,) = compare(acknowledged, graph(12, [1, 2, 3, 4, 5])).faults()
    assert "given twice" in fault


def test_a_record_that_was_never_published_may_have_removed_what_was_acknowledged(
    acknowledged: GraphMirror,
) -> None:
    assert compare(acknowledged, graph(14, [1, 2, 3, 4])).faults() == []


def test_a_difference_is_no_first_message(acknowledged: GraphMirror) -> None:
    faults = compare(acknowledged, graph(13, [5], base_version=12)).faults()
    assert any("not whole" in fault for fault in faults)
