"""The paper's baselines as local planners (Experimental Results, Baseline Algorithms), on our Local IRM.

Next-best-view chooses among paths to sampled viewpoints. The frontier-based one follows the way to the frontier that
gcp has chosen, and at its end looks at what is left uncovered there. Both know no value of what lies beyond their path.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planning.coverage_model import CoverageModel
from planning.frames import planar
from planning.randomness import stream
from schemas.policy import GlobalPolicy
from schemas.world import LocalIrm
from services.lcp.config import HfeConfig, NbvConfig
from services.lcp.problem import Junction
from services.lcp.viewpoints import Ints, View, Ways, best_view, viewpoints_within, ways_from

_LONGEST = 80
"""Moves of a path, at most."""
_LOOK_WITHIN_M = 12.0
"""A frontier is looked at from no farther than so much travel."""


class NextBestView:
    """Samples viewpoints around the robot, and keeps the last best one among the candidates (Bircher et al. 2016)."""

    def __init__(self, config: NbvConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._best: tuple[int, int, int] | None = None
        """Global lattice index and heading of the last best viewpoint."""

    def choose(self, irm: LocalIrm, model: CoverageModel, junction: Junction, episode: int) -> View | None:
        """The best viewpoint near the junction; where none is worth `min_reward`, the best of the window; else None."""
        c = self._config
        ways = ways_from(model, junction.node, c.risk_weight_m)
        for attempt, radius_m in enumerate((c.radius_m, math.inf)):
            within = viewpoints_within(model, ways, radius_m if math.isfinite(radius_m) else 1e9)
            view = best_view(model, ways, junction.heading, self._sample(within, episode, attempt), _LONGEST)
            view = self._or_last(irm, model, ways, junction, within, view)
            if view is not None and view.reward >= c.min_reward:
                node, heading = divmod(view.viewpoint, 8)
                self._best = (irm.ix0 + node % irm.size, irm.iy0 + node // irm.size, heading)
                return view
        self._best = None
        return None

    def _sample(self, within: Ints, episode: int, attempt: int) -> Ints:
        """Some of the viewpoints, each as likely, without repetition; all when they are few."""
        if len(within) <= self._config.samples:
            return within
        rng = stream(self._seed, "lcp", "nbv", episode, attempt)
        return np.sort(rng.choice(within, self._config.samples, replace=False))

    def _or_last(
        self,
        irm: LocalIrm,
        model: CoverageModel,
        ways: Ways,
        junction: Junction,
        within: Ints,
        view: View | None,
    ) -> View | None:
        """The last best viewpoint again, unless it is worth nothing any more or the new one is clearly better."""
        if self._best is None or not self._config.keep_best:
            return view
        column, row = self._best[0] - irm.ix0, self._best[1] - irm.iy0
        last = (row * irm.size + column) * 8 + self._best[2]
        if not (0 <= column < irm.size and 0 <= row < irm.size and np.isin(last, within)):
            return view
        again = best_view(model, ways, junction.heading, np.array([last]), _LONGEST)
        if again is None or again.reward < self._config.min_reward:
            return view
        is_better = view is not None and view.reward > again.reward * (1.0 + self._config.switch_share)
        return view if is_better else again

    def state(self) -> list[int]:
        """For a snapshot."""
        return list(self._best or ())

    def set_state(self, state: list[int]) -> None:
        """From a snapshot."""
        self._best = (state[0], state[1], state[2]) if state else None


class FrontierLook:
    """At the end of the way to a frontier: from where to see what is uncovered around it."""

    def __init__(self, config: HfeConfig) -> None:
        self._config = config
        self._looking_at = -1
        """The frontier that the way has ended at; -1: none."""

    def arrived(self, policy: GlobalPolicy | None) -> bool:
        """Whether the way to the target that there is has been driven to its end before."""
        return policy is not None and policy.target >= 0 and policy.target == self._looking_at

    def note_arrival(self, policy: GlobalPolicy) -> None:
        """The way to the target ends here."""
        self._looking_at = policy.target

    def near_target(self, irm: LocalIrm, policy: GlobalPolicy, entropy: np.ndarray) -> np.ndarray:
        """Entropy of the patches around the target; 0 for the others. (n,)"""
        x, y = planar(policy.map_to_odom).inverse().apply(*policy.target_xyz_m[:2])
        row, column = np.divmod(np.arange(irm.size**2), irm.size)
        dx = (irm.ix0 + column + 0.5) * irm.spacing_m - x
        dy = (irm.iy0 + row + 0.5) * irm.spacing_m - y
        return np.where(np.hypot(dx, dy) <= self._config.look_radius_m, entropy, 0.0)

    @staticmethod
    def choose(model: CoverageModel, junction: Junction, risk_weight_m: float) -> View | None:
        """The viewpoint that is worth most for what the model still counts; None when none is worth its way."""
        ways = ways_from(model, junction.node, risk_weight_m)
        within = viewpoints_within(model, ways, _LOOK_WITHIN_M)
        view = best_view(model, ways, junction.heading, within, _LONGEST)
        return view if view is not None and view.reward > 0.0 else None

    def state(self) -> Any:
        """For a snapshot."""
        return self._looking_at

    def set_state(self, state: Any) -> None:
        """From a snapshot."""
        self._looking_at = int(state)
