"""`plgrim doctor`: what is wrong with this machine or with a running system, and how to mend it."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer

from plgrim.commands.options import ConfigFile

_SIGNS = {"ok": "ok  ", "warning": "warn", "error": "BAD "}


def doctor(
    config_file: ConfigFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    listen: Annotated[
        float, typer.Option(min=0, max=60, help="How long to listen to a running system, wall seconds.")
    ] = 2.0,
) -> None:
    """Check machine, ports, certificates and a running system; say what to mend. Exit 1 when something is wrong."""
    from plgrim.config import check_all, load_config
    from plgrim.doctor.examine import examine

    config = load_config(config_file)
    check_all(config)
    findings = examine(config, listen)
    bad = any(finding.level == "error" for finding in findings)
    if as_json:
        print(json.dumps({"healthy": not bad, "findings": [f.summary() for f in findings]}, indent=2))
    else:
        for finding in findings:
            print(f"{_SIGNS[finding.level]} {finding.name}: {finding.says}")
            if finding.mend:
                print(f"       mend: {finding.mend}")
    sys.exit(1 if bad else 0)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(doctor)
