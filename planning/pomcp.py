"""POMCP: partially observable Monte-Carlo planning for any generative model (Silver and Veness 2010; paper, LLP).

The solver searches over histories: UCB picks the action at each history, the model draws the outcome, the
observation picks the next history, the model's rollout values a new one, and every action keeps the mean of the
returns that went through it. Each simulation starts from one particle of the root belief, drawn by the model.

A model is a `NamedTuple` of arrays and scalars and five compiled, module-level functions. Its state is one int64
array of a fixed length, written by `sample` and changed in place by `step` (one array, reused: no copies).

    sample(model, rng, state) -> None
        Write one particle of the root belief into `state`. Every element must be written.
    step(model, state, action, rng) -> (observation, reward, discount, terminal)
        Apply `action` in place. int64 observation in [0, 2^31), float reward of the whole step, float discount of
        what follows (per step, so that a macro action may discount by its length), bool terminal. After a terminal
        step nothing follows: a value that ends the episode (a leaf value) belongs into its reward.
    actions(model, state, actions_out) -> count
        Write the actions (int64, in the order in which untried ones are tried) and return how many, at most
        `max_actions` (not checked). They may depend on what the history makes known, not on what is hidden: they
        are asked once per history. 0 actions: the history is a leaf and is valued by `rollout(..., 0, ...)`.
    rollout(model, state, depth_left, rng) -> value
        Discounted return of the model's own rollout policy for at most `depth_left` more steps *plus* the value
        of the leaf. May change `state`. `depth_left` is 0 at the horizon: the leaf value alone.
    prior(model, state, actions, count, visits_out, values_out) -> None
        Virtual visits (int64, zeroed beforehand) and their mean value per action, when a history is expanded.
        The default, `no_prior`, gives none. A tree kept from before enters the same way: as a prior, not as truth.

The model's file registers them and holds the model's entry point:

    register_model(Tiger, sample=_sample, step=_step, actions=_actions, rollout=_rollout)   # prior=no_prior

    @njit
    def search_tiger(tree, model, settings, rng, simulations):
        simulate(tree, model, settings, rng, simulations)

The functions are chosen by the type of the model when the entry point is compiled, so a call costs nothing, and the
entry point is an ordinary kernel, cached on disk: a change in the model's file recompiles it. Keep the array types
of a model the same from call to call (dtype, dimensions, C order): another type compiles a second search.

Randomness comes only from `rng`, a uint64[4] array (`random_uniform(rng)` in [0, 1), `random_below(rng, n)`).

    solver = Pomcp(state_size=1, max_actions=3, max_nodes=1 << 16, max_branches=1 << 18, max_depth=40)
    report = solver.search(search_tiger, model, seed=7, simulations=4096, should_stop=lambda: clock() > deadline)
    # workers=2: two trees, grown by two threads from a stream each, then added up
    solver.root()                         # RootStatistics: actions, visits, values, max and mean value
    solver.best_action()                  # largest mean among the actions with enough visits
    solver.policy(min_visits=16)          # PolicyTree: flat arrays, down to histories with that many visits
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

from planning.pomcp_merge import merge_tree
from planning.pomcp_model import no_prior, register_model
from planning.pomcp_policy import (
    MIN_VISIT_SHARE,
    PolicyTree,
    RootStatistics,
    best_action,
    extract_policy,
    root_statistics,
)
from planning.pomcp_random import random_below, random_bits, random_stream, random_uniform
from planning.pomcp_tree import (
    BRANCHES,
    DEEPEST,
    NODES,
    NONE,
    REFUSED,
    SIMULATIONS,
    STEPS,
    SearchSettings,
    Tree,
    clear_tree,
    new_tree,
    simulate,
)

__all__ = [
    "MIN_VISIT_SHARE",
    "NONE",
    "PolicyTree",
    "Pomcp",
    "RootStatistics",
    "SearchReport",
    "SearchSettings",
    "Tree",
    "best_action",
    "clear_tree",
    "extract_policy",
    "new_tree",
    "no_prior",
    "random_below",
    "random_bits",
    "random_stream",
    "random_uniform",
    "register_model",
    "root_statistics",
    "simulate",
]


class SearchReport(NamedTuple):
    """What a search did.

    `simulations`: run in this call. `stopped_by`: what ended it. `nodes`, `branches`: in use. `refused`:
    simulations that a full tree kept from growing it. `deepest`: longest history, in steps. `mean_depth`: steps
    per simulation inside the tree. The last five count from the last clearing of the tree.
    """

    simulations: int
    stopped_by: Literal["simulations", "caller"]
    nodes: int
    branches: int
    refused: int
    deepest: int
    mean_depth: float


_WORKER = 0xD1342543DE82EF95
EntryPoint = Callable[[Tree, Any, SearchSettings, Any, int], None]


class Pomcp:
    """A tree, its settings and its random stream, allocated once and used for one search after another.

    `max_nodes` bounds the histories (one a simulation at most; 32 bytes each), `max_branches` the actions at
    expanded ones (20 bytes each; default four a node). When either is used up the search goes on without growing.
    `exploration`, `return_range` and `logarithmic` as in `SearchSettings`. `workers`: trees (each of these sizes) that
    as many threads grow, each from its own stream, and that are added up afterwards: `tree` is then their sum. The
    threads share nothing and hold no GIL, so that what they find depends on the seed and their number alone.
    `ValueError` on a size or a number out of range.
    """

    def __init__(
        self,
        *,
        state_size: int,
        max_actions: int,
        max_nodes: int,
        max_depth: int,
        max_branches: int | None = None,
        exploration: float = 0.25,
        return_range: float = 0.0,
        logarithmic: bool = False,
        workers: int = 1,
    ) -> None:
        if workers < 1:
            raise ValueError(f"workers {workers} must be at least 1")
        if not (0.0 <= exploration < float("inf") and 0.0 <= return_range < float("inf")):
            raise ValueError(
                f"exploration {exploration} and return_range {return_range} must be finite and >= 0"
            )
        self.settings = SearchSettings(
            int(max_depth), float(exploration), float(return_range), bool(logarithmic)
        )
        branches = 4 * max_nodes if max_branches is None else max_branches

        def tree(times: int) -> Tree:
            return new_tree(
                state_size=state_size,
                max_actions=max_actions,
                max_nodes=times * max_nodes,
                max_branches=times * branches,
                max_depth=max_depth,
            )

        self._trees = [tree(1) for _ in range(workers)]
        self.tree = self._trees[0] if workers == 1 else tree(workers)
        self._streams = [random_stream(i) for i in range(workers)]
        self._threads = ThreadPoolExecutor(workers - 1, "pomcp") if workers > 1 else None

    def search(
        self,
        entry_point: EntryPoint,
        model: Any,
        *,
        seed: int,
        simulations: int,
        should_stop: Callable[[], bool] | None = None,
        batch: int = 256,
        resume: bool = False,
    ) -> SearchReport:
        """Search from the model's root belief until `simulations` are run or `should_stop()` says so.

        `should_stop` is asked after every `batch` simulations (so at least one batch is run); the solver has no
        clock of its own. The result depends on `seed` and on the number of simulations run, not on `batch`.
        `resume` goes on with the tree and the stream of the last search, and ignores `seed`. `ValueError` if
        `simulations` or `batch` is below 1.
        """
        if simulations < 1 or batch < 1:
            raise ValueError(f"simulations {simulations} and batch {batch} must be at least 1")
        if not resume:
            for tree in self._trees:
                clear_tree(tree)
            self._streams = [random_stream(seed ^ (i * _WORKER)) for i in range(len(self._trees))]
        size = simulations if should_stop is None else batch
        done, stopped = 0, False
        while done < simulations and not stopped:
            count = min(size, simulations - done)
            self._run(entry_point, model, done, done + count)
            done += count
            stopped = should_stop is not None and should_stop()
        if len(self._trees) > 1:
            clear_tree(self.tree)
            for tree in self._trees:
                merge_tree(self.tree, tree)
        return self._report(done, "simulations" if done >= simulations else "caller")

    def _run(self, entry_point: EntryPoint, model: Any, first: int, last: int) -> None:
        """Simulations `first` to `last` of a search, shared out evenly whatever the batches are."""
        n = len(self._trees)

        def work(i: int) -> None:
            count = (last * (i + 1) // n - last * i // n) - (first * (i + 1) // n - first * i // n)
            entry_point(self._trees[i], model, self.settings, self._streams[i], count)

        # The first worker is this thread; it also compiles and loads the kernel if that is still to be done.
        others = [self._threads.submit(work, i) for i in range(1, n)] if self._threads is not None else []
        work(0)
        for other in others:
            other.result()

    def root(self, min_visit_share: float = MIN_VISIT_SHARE) -> RootStatistics:
        """Statistics of the root, see `RootStatistics`."""
        return root_statistics(self.tree, min_visit_share)

    def best_action(self, min_visit_share: float = MIN_VISIT_SHARE) -> int:
        """The action to take at the root, or NONE (-1) if there is none."""
        return best_action(self.tree, min_visit_share)

    def policy(self, min_visits: int, min_visit_share: float = MIN_VISIT_SHARE) -> PolicyTree:
        """The greedy policy with its observation branches, see `extract_policy`."""
        return extract_policy(self.tree, min_visits, min_visit_share)

    def _report(self, done: int, stopped_by: Literal["simulations", "caller"]) -> SearchReport:
        counters = self.tree.counters
        return SearchReport(
            simulations=done,
            stopped_by=stopped_by,
            nodes=int(counters[NODES]),
            branches=int(counters[BRANCHES]),
            refused=int(counters[REFUSED]),
            deepest=int(counters[DEEPEST]),
            mean_depth=float(counters[STEPS] / max(1, counters[SIMULATIONS])),
        )
