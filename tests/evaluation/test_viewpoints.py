"""Viewpoints: what is seen is what the judge sees, and the cover is greedy and complete."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from planning.randomness import stream
from plgrim.evaluation.tour import tour_judge
from plgrim.evaluation.viewpoints import SAMPLE, cover, sampled, views
from services.sim.config import CoverageSensorConfig
from tests.evaluation.worlds import CONFIG, rooms, silent

_WALLS = ((3.0, 0.0, 3.2, 2.5), (5.0, 1.5, 5.2, 4.0))


def test_a_view_is_what_the_judge_sees_with_a_sensor_all_around() -> None:
    flat = rooms(8.0, 4.0, _WALLS)
    bumpy = np.zeros(flat.spec.shape, np.float32)
    bumpy[:25, 40:43] = 0.6  # sees over it, but not what lies close behind
    around = CONFIG.model_copy(update={"coverage_sensor": CoverageSensorConfig(fov_deg=360.0)})
    points = np.array([[1.0, 1.0], [4.0, 3.0], [7.0, 2.2]])
    for world in (flat, rooms(8.0, 4.0, _WALLS[:1], floor_m=bumpy)):
        for (x_m, y_m), seen in zip(
            points.tolist(), views(tour_judge(world, CONFIG), points, silent), strict=True
        ):
            judge = tour_judge(world, around)
            judge.update(x_m, y_m, 0.3)
            assert seen.size > 0
            assert seen.tolist() == np.flatnonzero(sampled(judge.covered)).tolist()


def test_views_leave_the_judge_as_it_was() -> None:
    judge = tour_judge(rooms(8.0, 4.0), CONFIG)
    before = judge.update(1.0, 1.0, 0.0)
    views(judge, np.array([[6.0, 2.0]]), silent)
    assert judge.covered.sum() == before
    assert judge.update(1.0, 1.0, 0.0) == 0
    assert judge.update(6.0, 2.0, 0.0) > 0


def test_samples_stand_for_all() -> None:
    judge = tour_judge(rooms(8.0, 4.0), CONFIG)
    share = sampled(judge.reachable).sum() * SAMPLE**2 / judge.reachable.sum()
    assert 0.95 < share < 1.05


@given(seed=st.integers(0, 1000), least=st.integers(1, 6))
def test_a_cover_is_greedy_and_leaves_nothing_worth_a_viewpoint(seed: int, least: int) -> None:
    rng = stream(seed, "cover")
    seen_from = [np.flatnonzero(rng.random(60) < rng.random() * 0.5) for _ in range(12)]
    wanted = (rng.random(60) < 0.8).reshape(6, 10)
    left = wanted.reshape(-1).copy()
    for viewpoint in cover(seen_from, wanted, least):
        counts = [int(left[cells].sum()) for cells in seen_from]
        assert counts[viewpoint.place] == max(counts) >= least
        assert sorted(viewpoint.owned) == sorted(c for c in seen_from[viewpoint.place].tolist() if left[c])
        left[viewpoint.owned] = False
    assert max(int(left[cells].sum()) for cells in seen_from) < least
