"""A stage that is ready has its kernels: none of those below compiles or loads another in the middle of a mission."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.runtime.helpers import REPOSITORY

_WARM = ("irm", "gcp", "reconciler")
"""Of the others a few come with their first steps, all in the rehearsal of `plgrim.warmup`."""
_MISSION_S = 14
"""Long enough for a graph that outgrows its first pool."""
_LOOK = """
import json, sys
from numba.core.dispatcher import Dispatcher
from plgrim.config import Config
from plgrim.registry import STAGES
from plgrim.runtime.lockstep import Lockstep
from plgrim.warmup import warm_ups

now, late, compile_ = [""], [], Dispatcher.compile
def noted(self, signature):
    late.append((now[0], f"{self.__module__}.{self.__name__}"))
    return compile_(self, signature)

for work in warm_ups().values():
    work()
config = Config.model_validate({"sim": {"world": "subway_1x"}})
lockstep = Lockstep({name: config.options(name) for name in STAGES}, seed=1)
def stepped(name, step):
    def run(*arguments):
        now[0] = name
        return step(*arguments)
    return run
for name in STAGES:
    stage = lockstep.stage(name)
    stage.step = stepped(name, stage.step)
Dispatcher.compile = noted
lockstep.run_until(int(sys.argv[1]) * 10**9)
print(json.dumps(late))
"""


@pytest.mark.slow
def test_no_kernel_comes_late() -> None:
    command = [sys.executable, "-c", _LOOK, str(_MISSION_S)]
    ran = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    late = json.loads(ran.stdout.splitlines()[-1])
    assert late, "lcp loads some with its first plan: the look works"
    assert sorted({(stage, kernel) for stage, kernel in late if stage in _WARM}) == []
