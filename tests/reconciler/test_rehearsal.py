"""The steps that warm a reconciler up do what a mission does: else a kernel is left for the middle of one."""

from __future__ import annotations

from schemas.contract import Inputs, Outputs, Stamp
from schemas.policy import EpisodeRequest, Plan
from schemas.topics import LOCAL_IRM, RISK_MAP
from services.reconciler.config import Config
from services.reconciler.rehearsal import rehearse
from services.reconciler.stage import ReconcilerStage


class Noted(ReconcilerStage):
    """Keeps what it was given and what it said."""

    def __init__(self) -> None:
        super().__init__(Config(), 0)
        self.inputs: list[Inputs] = []
        self.requests: list[EpisodeRequest] = []
        self.plans: list[Plan] = []

    def step(self, now: Stamp, inputs: Inputs) -> Outputs:
        """The stage's own."""
        found = super().step(now, inputs)
        self.inputs.append(inputs)
        self.requests += [o.message for o in found if isinstance(o.message, EpisodeRequest)]
        self.plans += [o.message for o in found if isinstance(o.message, Plan)]
        return found


def test_episodes_are_opened_kept_in_part_and_cut_short() -> None:
    stage = Noted()
    rehearse(stage)
    assert len(stage.requests) >= 3, "from here, and from a junction on the old path"
    assert any(plan.tau_s > 0.0 and plan.kept_points > 0 for plan in stage.plans)
    ends_m = [float(plan.x_m[-1]) for plan in stage.plans if plan.valid]
    assert ends_m[-1] < max(ends_m) - 1.0, "truncated before what stands on the path"


def test_arrays_are_read_only_as_those_of_decoded_messages() -> None:
    stage = Noted()
    rehearse(stage)
    risk, irm = stage.inputs[0].current(RISK_MAP), stage.inputs[0].current(LOCAL_IRM)
    assert risk is not None and irm is not None
    assert not any(
        a.flags.writeable for a in (risk.state, risk.clearance_m, irm.edge_distance_m, irm.visible)
    )
