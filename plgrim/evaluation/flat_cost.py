"""What irm and gcp cost against the distance driven: `python -m plgrim.evaluation.flat_cost`.

The real stages, one after the other as in lock-step, in a network of tunnels that a robot drives through at 1 m/s by
depth-first search; risk maps and looks come from the plan of the tunnels. The cost of a step is CPU time of its thread,
so that other processes on the machine do not count; that of a message is its size on the wire. Nothing may grow with
what has been driven. Only steps over new ground are compared: how often the search turns back differs from one
kilometre to another, and the way back out of a dead end costs less.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from planning.footprint import clearance_m
from planning.frames import Planar
from planning.grid import FREE, LETHAL, UNKNOWN, GridSpec, window_around
from planning.randomness import stream
from planning.rays import visible_cells
from schemas.base import Message, Pose
from schemas.codec import Envelope, decode, encode
from schemas.contract import SECOND_NS, Inputs, Output, Outputs, Received, Stage, StageSetup
from schemas.sensing import CoverageScan, Odometry, PoseGraph
from schemas.topics import COVERAGE_SCAN, GLOBAL_IRM, GLOBAL_POLICY, ODOMETRY, POSE_GRAPH, RISK_MAP
from schemas.world import GridHeader, RiskMap
from services.gcp import stage as gcp
from services.irm import stage as irm

RES = 0.2
PITCH_M, WIDTH_M = 16.0, 3.6
WINDOW_M, RANGE_M, LOOK_M = 40.0, 18.0, 6.0
RADIUS_M = 0.4
KEYFRAME_M = 2.0
BIN_M = 250.0

Cells = NDArray[np.uint8]


class Tunnels:
    """Crossings on a square lattice, joined to a tree with some loops by tunnels; solid rock around them."""

    def __init__(self, side: int, seed: int) -> None:
        self.side = side
        self._rng = stream(seed, "flat_cost")
        self.joined: set[tuple[int, int]] = set()
        self.route = self._dig()
        for node in range(side * side):
            for other in self._beside(node):
                if node < other and self._rng.random() < 0.08:
                    self.joined.add((node, other))
        self.spec, self.state = self._plan()
        self.clearance_m = clearance_m(self.state == LETHAL, None, None, self.spec, 2.0)
        self.seen = np.zeros(self.state.shape, np.bool_)

    def _beside(self, node: int) -> list[int]:
        row, column = divmod(node, self.side)
        around = ((row, column + 1), (row + 1, column), (row, column - 1), (row - 1, column))
        return [r * self.side + c for r, c in around if 0 <= r < self.side and 0 <= c < self.side]

    def _dig(self) -> list[int]:
        """A random spanning tree; the crossings in the order of a walk along it, back out of dead ends too."""
        walk, stack, dug = [0], [0], {0}
        while stack:
            ahead = [n for n in self._beside(stack[-1]) if n not in dug]
            if ahead:
                other = ahead[int(self._rng.integers(len(ahead)))]
                self.joined.add((min(stack[-1], other), max(stack[-1], other)))
                dug.add(other)
                stack.append(other)
                walk.append(other)
            else:
                stack.pop()
                walk += stack[-1:]
        return walk

    def place(self, node: int) -> tuple[float, float]:
        """Of a crossing, m."""
        return PITCH_M * (node % self.side), PITCH_M * (node // self.side)

    def _plan(self) -> tuple[GridSpec, Cells]:
        cells = math.ceil((PITCH_M * self.side + WINDOW_M) / RES)
        low = -math.ceil(WINDOW_M / RES / 2)
        spec = GridSpec(RES, low, low, cells, cells)
        state = np.full(spec.shape, LETHAL, np.uint8)
        x, y = spec.centres_x(), spec.centres_y()
        for a, b in sorted(self.joined):
            (ax, ay), (bx, by) = self.place(a), self.place(b)
            columns = (x > min(ax, bx) - WIDTH_M / 2) & (x < max(ax, bx) + WIDTH_M / 2)
            rows = (y > min(ay, by) - WIDTH_M / 2) & (y < max(ay, by) + WIDTH_M / 2)
            state[np.ix_(rows, columns)] = FREE
        return spec, state

    def poses(self, step_m: float) -> Iterable[tuple[Planar, bool]]:
        """The drive, a pose every so many metres, and whether it lies on the way to a crossing that is new."""
        been = {self.route[0]}
        for a, b in zip(self.route[:-1], self.route[1:], strict=True):
            new = b not in been
            been.add(b)
            (ax, ay), (bx, by) = self.place(a), self.place(b)
            steps = round(PITCH_M / step_m)
            for k in range(steps):
                share = k / steps
                at = Planar(ax + share * (bx - ax), ay + share * (by - ay), math.atan2(by - ay, bx - ax))
                yield at, new

    def risk_map(self, at: Planar, stamp_ns: int) -> RiskMap:
        """What has been seen of the tunnels, in the window around the robot."""
        spec = window_around(at.x_m, at.y_m, WINDOW_M, RES)
        part = (
            slice(spec.iy0 - self.spec.iy0, spec.iy0 - self.spec.iy0 + spec.height),
            slice(spec.ix0 - self.spec.ix0, spec.ix0 - self.spec.ix0 + spec.width),
        )
        state, out = self.state[part], np.zeros(spec.shape, np.uint8)
        x, y = at.x_m / RES - spec.ix0, at.y_m / RES - spec.iy0
        visible_cells(state != FREE, x, y, RANGE_M / RES, 0.0, math.tau, out)
        padded = np.pad(out != 0, 1)
        rows = padded[:-2] | padded[1:-1] | padded[2:]
        self.seen[part] |= rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
        state = np.where(self.seen[part], state, np.uint8(UNKNOWN))
        hazard = np.where(state == FREE, 0.01, 1.0).astype(np.float32)
        zeros = np.zeros(spec.shape, np.float32)
        return RiskMap(
            stamp_ns=stamp_ns,
            grid=GridHeader(**spec._asdict()),
            robot_pose=_pose(at),
            footprint_radius_m=RADIUS_M,
            state=state,
            hazard_mean=hazard,
            hazard_variance=zeros,
            hazard_cvar=hazard,
            clearance_m=np.where(self.seen[part], self.clearance_m[part], np.float32(2.0)),
            elevation_m=zeros,
            top_m=np.zeros((0, 0), np.float32),
        )


@dataclass(slots=True)
class Costs:
    """Of each step: distance (m), whether over new ground, CPU time by stage (ms), size by topic (bytes).

    A list by stage or topic may end before the last step: nothing was spent or sent from there on.
    """

    distance_m: list[float] = field(default_factory=list)
    new: list[bool] = field(default_factory=list)
    cpu_ms: dict[str, list[float]] = field(default_factory=dict)
    size: dict[str, list[int]] = field(default_factory=dict)

    def binned(
        self, values: list[float] | list[int], quantile: float | None
    ) -> tuple[list[float], list[float]]:
        """(middle of each bin in m, quantile over its new ground; None: mean). Bins without new ground are left out."""
        bins = np.floor(np.array(self.distance_m) / BIN_M).astype(int)
        array, new = self._of_each_step(values), np.array(self.new)
        middles, found = [], []
        for b in range(int(bins.max()) + 1):
            inside = array[(bins == b) & new]
            if inside.size:
                middles.append((b + 0.5) * BIN_M)
                found.append(float(inside.mean() if quantile is None else np.quantile(inside, quantile)))
        return middles, found

    def ratio(self, values: list[float] | list[int]) -> tuple[float, float, float]:
        """(mean over the first km after the first bin, mean over the last km, their ratio), of steps over new ground.

        nan where there is no new ground, or nothing to divide by.
        """
        array = self._of_each_step(values)
        first, last = (float(array[k].mean()) if k.size else math.nan for k in self.compared())
        return first, last, last / first if first else math.nan

    def compared(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The steps over new ground in the first km after the first bin, and in the last km."""
        at, new = np.array(self.distance_m), np.array(self.new)
        first = (at >= BIN_M) & (at < BIN_M + 1000.0)
        return np.flatnonzero(new & first), np.flatnonzero(new & (at >= at[-1] - 1000.0))

    def _of_each_step(self, values: list[float] | list[int]) -> NDArray[np.float64]:
        """(steps,): 0 where the list has ended before."""
        array = np.zeros(len(self.distance_m))
        array[: len(values)] = values
        return array


class Robot:
    """Drives, and runs the two stages as lock-step does: through the real codec."""

    def __init__(self, tunnels: Tunnels, seed: int) -> None:
        self.tunnels = tunnels
        setup = StageSetup("robot", seed)
        self.stages: dict[str, Stage] = {
            "irm": irm.create(irm.Config(), setup),
            "gcp": gcp.create(gcp.Config(), setup),
        }
        self.costs = Costs(cpu_ms={"irm": [], "gcp": []})
        self.keyframes: list[Planar] = []
        self.now, self.distance_m = 0, 0.0
        self._policy: list[Output] = []

    def step(self, at: Planar, driven_m: float, new: bool) -> None:
        """One step of both stages, `driven_m` after the last one. new: on the way to where it has not been."""
        self.distance_m += driven_m
        self.now += round(driven_m * SECOND_NS)
        if not self.keyframes or math.dist(at[:2], self.keyframes[-1][:2]) >= KEYFRAME_M:
            self.keyframes.append(at)
        self.costs.distance_m.append(self.distance_m)
        self.costs.new.append(new)
        odometry = Output(ODOMETRY, self._odometry(at))
        sensed = [Output(RISK_MAP, self.tunnels.risk_map(at, self.now)), odometry, self._pose_graph()]
        belief = self._run("irm", [*sensed, *self._looks(at), *self._policy])
        graph = [o for o in belief if o.topic.name == GLOBAL_IRM.name]
        self._policy = [o for o in self._run("gcp", [odometry, *graph]) if o.topic.name == GLOBAL_POLICY.name]

    def _run(self, name: str, messages: list[Output]) -> Outputs:
        inputs = _inputs(messages)
        before = time.thread_time()
        found = self.stages[name].step(self.now, inputs)
        self.costs.cpu_ms[name].append(1e3 * (time.thread_time() - before))
        return [self._over_the_wire(name, output) for output in found]

    def _over_the_wire(self, name: str, output: Output) -> Output:
        payload = encode(output.message, Envelope("robot", name, 1, 1, self.now, {}))
        sizes = self.costs.size.setdefault(output.topic.name, [])
        sizes += [0] * (len(self.costs.distance_m) - 1 - len(sizes))
        sizes.append(len(payload))
        return Output(output.topic, decode(payload, output.topic.message, output.topic.max_bytes)[0])

    def _odometry(self, at: Planar) -> Odometry:
        return Odometry(
            stamp_ns=self.now,
            pose=_pose(at),
            map_to_odom=Pose(),
            speed_mps=1.0,
            turn_rate_radps=0.0,
            covariance=np.eye(3) * 1e-4,
        )

    def _pose_graph(self) -> Output:
        rows = np.array([(k.x_m, k.y_m, 0.0, k.yaw_rad) for k in self.keyframes])
        count = len(self.keyframes)
        graph = PoseGraph(
            stamp_ns=self.now,
            revision=0,
            keyframe_id=np.arange(count),
            pose_in_map=rows,
            covariance=np.full((count, 3), 1e-6),
        )
        return Output(POSE_GRAPH, graph)

    def _looks(self, at: Planar) -> list[Output]:
        newest = len(self.keyframes) - 1
        looks = []
        for k in range(3):
            look = Planar(at.x_m, at.y_m, math.remainder(at.yaw_rad + k * math.tau / 3, math.tau))
            local = self.keyframes[newest].inverse().compose(look)
            scan = CoverageScan(
                stamp_ns=self.now,
                keyframe_id=newest,
                pose_in_odom=_pose(look),
                pose_in_keyframe=_pose(local),
                range_m=LOOK_M,
                fov_rad=2.2,
                detection_probability=0.95,
            )
            looks.append(Output(COVERAGE_SCAN, scan))
        return looks


def _pose(at: Planar) -> Pose:
    return Pose(x_m=at.x_m, y_m=at.y_m, yaw_rad=at.yaw_rad)


def _inputs(messages: list[Output]) -> Inputs:
    found: dict[str, list[Received[Message]]] = {}
    for k, output in enumerate(messages):
        received = Received(output.message, "flat_cost", 1, k, 0, 0, True, False)
        found.setdefault(output.topic.name, []).append(received)
    return Inputs(found)


def drive(distance_m: float, step_m: float, seed: int) -> Costs:
    """Drive so far through tunnels that are long enough."""
    crossings = math.ceil(math.sqrt(distance_m / PITCH_M)) + 2
    tunnels = Tunnels(crossings, seed)
    robot = Robot(tunnels, seed)
    gcp.warm_up()
    for at, new in tunnels.poses(step_m):
        robot.step(at, step_m, new)
        if robot.distance_m >= distance_m:
            break
    return robot.costs


def plot(costs: Costs, path: Path) -> None:
    """CPU time of a step and size of the messages, by distance driven."""
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for (name, values), colour in zip(costs.cpu_ms.items(), ("#1d4ed8", "#c2410c"), strict=True):
        for quantile, style in ((0.5, "-"), (0.95, "--")):
            label = f"{name}, p{round(100 * quantile)}"
            upper.plot(*costs.binned(values, quantile), style, color=colour, label=label)
    upper.set_ylabel("CPU time of a step over new ground [ms]")
    for name, sizes in sorted(costs.size.items()):
        lower.plot(*costs.binned(sizes, None), label=name)
    lower.set_yscale("log")
    lower.set_ylabel("published in such a step, mean [bytes]")
    lower.set_xlabel("distance driven [m]")
    for axes in (upper, lower):
        axes.set_ylim(bottom=0 if axes is upper else None)
        axes.grid(visible=True, alpha=0.3)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
    figure.savefig(path, dpi=110)


def report(costs: Costs) -> list[str]:
    """Mean over the first km after the warm-up, over the last km, and their ratio: of each stage and each topic.

    And how many steps over new ground that is from: where they are few, or none, another seed tells more.
    """
    lines = [f"{'':28}{'first km':>12}{'last km':>12}{'ratio':>8}"]
    first_steps, last_steps = (k.size for k in costs.compared())
    lines.append(f"{'steps over new ground':28}{first_steps:12d}{last_steps:12d}")
    for name, values in costs.cpu_ms.items():
        first, last, ratio = costs.ratio(values)
        lines.append(f"{name + ' step, CPU ms':28}{first:12.2f}{last:12.2f}{ratio:8.2f}")
    for topic, sizes in sorted(costs.size.items()):
        first, last, ratio = costs.ratio(sizes)
        lines.append(f"{topic + ', bytes':28}{first:12.0f}{last:12.0f}{ratio:8.2f}")
    return lines


def main(
    distance_m: Annotated[float, typer.Option(help="How far to drive, m.")] = 5000.0,
    step_m: Annotated[float, typer.Option(help="Distance between two steps at 1 m/s, m.")] = 2.0,
    seed: Annotated[int, typer.Option(help="Of the tunnels.")] = 1,
    out: Annotated[Path, typer.Option(help="The plot.")] = Path("flat_cost.png"),
) -> None:
    """Drive through tunnels and print and plot what a step of irm and gcp costs."""
    started = time.perf_counter()
    costs = drive(distance_m, step_m, seed)
    plot(costs, out)
    print("\n".join(report(costs)))
    took_s = time.perf_counter() - started
    print(f"{costs.distance_m[-1]:.0f} m in {len(costs.distance_m)} steps, {took_s:.0f} s; plot: {out}")


if __name__ == "__main__":
    typer.run(main)
