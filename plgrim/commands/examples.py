"""An example for the `--help` of every command: in one place, where a test finds those that are missing or wrong."""

from __future__ import annotations

import typer

EXAMPLES: dict[str, tuple[str, ...]] = {
    "demo": ("plgrim demo --seed 2",),
    "explore": (
        "plgrim explore --world maze --seed 7 --out out/maze",
        "plgrim explore --map my_building.yaml --start 2.5 -1.0 --time-budget 600",
    ),
    "up": ("plgrim up --config robot.yaml --keep",),
    "recover": ("plgrim recover out/up",),
    "watch": ("plgrim watch --out out/mission",),
    "run": ("plgrim run gcp --config robot.yaml",),
    "router": ("plgrim router --listen tcp/127.0.0.1:7457",),
    "link": ("plgrim link --config robot.yaml",),
    "doctor": ("plgrim doctor --config robot.yaml", "plgrim doctor --json"),
    "status": ("plgrim status --url http://127.0.0.1:8080",),
    "healthcheck": ("plgrim healthcheck gcp",),
    "topics": ("plgrim topics",),
    "record": ("plgrim record --out out/recording --max-mb 2000",),
    "fetch": ("plgrim fetch --out out/from_robot",),
    "replay": (
        "plgrim replay out/recording",
        "plgrim replay out/recording --stages lcp,reconciler --speed 2",
    ),
    "report": ("plgrim report out/demo", "plgrim report out/recording --animate out/mission.png"),
    "foxglove": ("plgrim foxglove --port 8765", "plgrim foxglove --recording out/recording --speed 2"),
    "feed": ("plgrim feed intel.g2o --gcp --out out/intel", "plgrim feed drive.bag --scan /front_laser"),
    "evaluate missions": ("plgrim evaluate missions --world cave --seeds 1-10 --variant default",),
    "evaluate paper": ("plgrim evaluate paper --seeds 1 --world subway_1x --time-scale 0.2",),
    "evaluate tune": ("plgrim evaluate tune nbv --seeds 101-103",),
    "evaluate reconciliation": ("plgrim evaluate reconciliation --seeds 1-10",),
    "evaluate tour": ("plgrim evaluate tour --world maze --seed 3",),
    "evaluate rocksample": ("plgrim evaluate rocksample",),
    "evaluate grid": ("plgrim evaluate grid --maps maps --rules ariadne",),
}
"""By the words of the command."""


def add_examples(app: typer.Typer, words: str = "") -> None:
    """Put the examples under the help of each command of an application and of its groups."""
    for command in app.registered_commands:
        name = command.name or (command.callback.__name__.replace("_", "-") if command.callback else "")
        lines = EXAMPLES.get(f"{words} {name}".strip(), ())
        if lines and command.epilog is None:
            # A line of its own for each: what stands together is filled up to one paragraph.
            command.epilog = "\n\n".join(f"Example: {line}" for line in lines)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            below = group.name if isinstance(group.name, str) else group.typer_instance.info.name
            add_examples(group.typer_instance, f"{words} {below}".strip())
