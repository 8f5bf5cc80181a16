"""The services by name. Imported only when asked for, so that a process loads its own stage and no other."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from schemas.contract import Stage, StageSetup, StageSpec

STAGES = ("riskmap", "irm", "gcp", "lcp", "reconciler", "mission", "sim")
"""Services that are stages, in the order in which lock-step runs those that are due together."""


def stage_module(name: str) -> Any:
    """The module `services.<name>.stage`, which has SPEC, Config and create(config, setup)."""
    if name not in STAGES:
        raise KeyError(f"no stage {name!r}; there are {', '.join(STAGES)}")
    return importlib.import_module(f"services.{name}.stage")


def make_stage(name: str, options: Mapping[str, Any], setup: StageSetup) -> tuple[StageSpec, Stage]:
    """A stage and how to run it. options: its part of the configuration; unknown keys are refused."""
    module = stage_module(name)
    config = module.Config.model_validate(dict(options))
    stage: Stage = module.create(config, setup)
    return module.spec(config), stage
