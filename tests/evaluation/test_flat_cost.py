"""What the cost against distance is taken from: like is compared with like, whatever way the drive takes."""

from __future__ import annotations

import math

import pytest

from plgrim.evaluation.flat_cost import Costs, Tunnels, report


def _costs(new: list[bool]) -> Costs:
    """Steps of 10 m."""
    return Costs(distance_m=[10.0 * (k + 1) for k in range(len(new))], new=new)


def test_only_steps_over_new_ground_are_compared() -> None:
    """A step over new ground costs 8, one back over old ground 2; the last kilometre is mostly the way back."""
    new = [k < 300 or k % 10 == 0 for k in range(400)]
    costs = _costs(new)
    values = [8.0 if n else 2.0 for n in new]
    assert costs.ratio(values) == (8.0, 8.0, 1.0)
    assert set(costs.binned(values, None)[1]) == {8.0}
    assert [k.size for k in costs.compared()] == [100, 11]


def test_a_topic_that_is_not_sent_up_to_the_last_step_counts_as_nothing_from_there_on() -> None:
    costs = _costs([True] * 300)
    costs.size = {"gcp/graph_request": [0] * 30 + [100]}
    first, last, ratio = costs.ratio(costs.size["gcp/graph_request"])
    assert (first, last, ratio) == (1.0, 0.0, 0.0)
    assert costs.binned(costs.size["gcp/graph_request"], None)[1][-1] == 0.0
    assert any("gcp/graph_request" in line for line in report(costs))


def test_a_last_kilometre_without_new_ground_gives_no_ratio() -> None:
    costs = _costs([k < 200 for k in range(400)])
    first, last, ratio = costs.ratio([1.0] * 400)
    assert first == 1.0 and math.isnan(last) and math.isnan(ratio)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_drive_tells_new_ground_from_the_way_back(seed: int) -> None:
    tunnels = Tunnels(4, seed)
    drive = list(tunnels.poses(4.0))
    assert len(drive) == 4 * (len(tunnels.route) - 1)
    # A spanning tree: each crossing but the first is new once.
    assert sum(new for _, new in drive) == 4 * (4 * 4 - 1)
