"""The steps that warm irm up do what a mission does: else a kernel is left for the middle of one."""

from __future__ import annotations

from schemas.contract import Inputs, Outputs, Stamp
from schemas.topics import COVERAGE, GLOBAL_IRM, LOCAL_IRM
from schemas.world import FRONTIER, CoverageSummary, GlobalIrm, LocalIrm
from services.irm.config import Config
from services.irm.rehearsal import rehearse
from services.irm.stage import IrmStage


class Noted(IrmStage):
    """Keeps what it said."""

    def __init__(self) -> None:
        super().__init__(Config(size=11, sensor_range_m=3.0))
        self.said: list[Outputs] = []

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """The stage's own."""
        self.said.append(super().step(now, inputs))
        return self.said[-1]


def test_each_step_gives_both_graphs_and_covers_more() -> None:
    stage = Noted()
    rehearse(stage)
    wanted = {LOCAL_IRM.name, GLOBAL_IRM.name, COVERAGE.name}
    assert all(wanted <= {output.topic.name for output in found} for found in stage.said)
    messages = [output.message for found in stage.said for output in found]
    covered = [m.covered_area_m2 for m in messages if isinstance(m, CoverageSummary)]
    assert covered[-1] > covered[0] > 0.0
    assert any(FRONTIER in m.node_kind for m in messages if isinstance(m, GlobalIrm))
    assert all((m.edge_distance_m > 0).any() for m in messages if isinstance(m, LocalIrm))
