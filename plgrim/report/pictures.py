"""The README's pictures, by missions in lock-step that are drawn as they go: `make pictures`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from plgrim.config import Config, load_config
from plgrim.registry import STAGES
from plgrim.report.frames import FrameMaker, with_few_colours
from plgrim.runtime.lockstep import Lockstep
from schemas.base import Message
from schemas.contract import SECOND_NS, Stamp, Topic
from schemas.operation import FinishReason, MissionState

WORLDS: dict[str, tuple[str, int, float, float]] = {
    "lava_tube": ("short_lava_tube", 1, 900.0, 5.0),
    "subway": ("subway_1x", 3, 900.0, 5.0),
    "cave": ("cave", 1, 900.0, 8.0),
}
"""By picture: world, seed, mission seconds at most, seconds between frames."""


def drive(config: Config, maker: FrameMaker, limit_s: float) -> None:
    """A mission in lock-step, shown to the maker of frames, until its end or the limit."""
    finished = [False]

    def observe(topic: Topic[Message], message: Message, now: Stamp) -> None:
        del topic
        maker.observe(message, now)
        if isinstance(message, MissionState) and message.finish is not FinishReason.NONE:
            finished[0] = True

    run = Lockstep({name: config.options(name) for name in STAGES}, config.seed, config.robot, observe)
    while not finished[0] and run.now < limit_s * SECOND_NS:
        run.run_until(run.now + SECOND_NS)
    maker.frames.append(maker.draw(run.now))


def make(name: str, out: Path, limit_s: float | None = None) -> list[Path]:
    """The still picture and the animation of one of WORLDS; their paths."""
    world, seed, longest_s, every_s = WORLDS[name]
    overrides: dict[str, Any] = {"seed": seed, "sim": {"world": world}}
    maker = FrameMaker(every_s=every_s)
    drive(load_config(None, overrides), maker, limit_s or longest_s)
    still, moving = out / f"{name}.png", out / f"{name}_mission.png"
    out.mkdir(parents=True, exist_ok=True)
    with_few_colours(maker.frames[-1]).save(still, optimize=True)
    size = maker.save(moving)
    print(f"{still}, {moving}: {len(maker.frames)} frames, {size / 1e6:.2f} MB", flush=True)
    return [still, moving]


def main() -> None:
    """Make all of them, or those that are named."""
    parser = argparse.ArgumentParser(description="Make the README's pictures.")
    parser.add_argument("names", nargs="*", default=list(WORLDS), choices=[*WORLDS, []], help="default: all")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    parser.add_argument("--limit", type=float, default=None, help="mission seconds at most")
    arguments = parser.parse_args()
    for name in arguments.names or list(WORLDS):
        make(name, arguments.out, arguments.limit)


if __name__ == "__main__":
    main()
