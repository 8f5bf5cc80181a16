"""The short form of every bench: `python -m tests.bench [NAME ...]`, which is `make bench`.

A bench is a command of its own; here each runs with arguments that make it short, one after another. To hang in
another, add a line to `BENCHES`.
"""

from __future__ import annotations

import subprocess
import sys
import time

_ROCKS = "-m plgrim evaluate rocksample --simulations 1024 --size"

BENCHES = {
    "riskmap": "-m tests.bench.riskmap --rounds 40",
    "rocksample-7": f"{_ROCKS} 7 8 --episodes 100",
    "rocksample-11": f"{_ROCKS} 11 11 --episodes 100 --speed 5",
    "rocksample-15": f"{_ROCKS} 15 15 --episodes 50",
    "lcp-speed": "-m tests.bench.lcp_speed --rounds 10",
    "lcp-gap": "-m tests.bench.lcp_gap --lattices 40",
    "lcp-worlds": "-m tests.bench.lcp_worlds --worlds 4",
    "planning-step": "-m tests.bench.planning_step --seconds 120",
    "qmdp": "-m tests.bench.qmdp --rounds 9 --peer-rounds 1",
}
"""Name: arguments of the interpreter."""


def main(names: list[str]) -> int:
    """Run the named benches, or all; 1 if one failed, 2 if one is unknown."""
    unknown = sorted(set(names) - set(BENCHES))
    if unknown:
        print(
            f"bench: no bench is called {', '.join(unknown)}; there are {', '.join(BENCHES)}", file=sys.stderr
        )
        return 2
    failed = []
    for name in names or BENCHES:
        print(f"--- {name}: python {BENCHES[name]}", flush=True)
        began = time.monotonic()
        if subprocess.run([sys.executable, *BENCHES[name].split()], check=False).returncode != 0:
            failed.append(name)
        print(f"    {time.monotonic() - began:.0f} s", flush=True)
    if failed:
        print(f"bench: failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
