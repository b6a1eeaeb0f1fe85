"""Our bundle adjustment against Ceres, which pycolmap runs on the same problem in the same process.

    python -m scripts.bench_bundle [PROBLEM ...] [--synthetic 20x5000 100x20000x10 500x50000x10 2000x50000x10]
                                   [--street 10000x1000000] [--intrinsics free fixed] [--curve] [--plot FILE] [--json]

A PROBLEM is a file of Bundle Adjustment in the Large, of GBP (fr1desk…) or of sba (7pts.txt, with 7cams.txt and
calib.txt beside it), or the folder of a COLMAP model, e.g. SCENE/sparse/0 of an `sfm run`; --disturb moves the poses
and points of models before the race, since the start is a solution. A synthetic size is IMAGESxPOINTS or
IMAGESxPOINTSxTRACK_LENGTH; a street runs on our side only, unless --ceres-too.

Both sides start from the same numbers, free the same parameters (poses, points, focal lengths and distortion; with
--intrinsics fixed only poses and points), agree on the same seven freedoms (the pose of one image and one direction of
a second, which Ceres holds and ours restores in the end), minimise the same loss on the same number of threads, and
stop by the same rules: a step that lowers the cost by less than --tolerance of it (Ceres: function_tolerance; ours asks
in addition that the step was little damped and had promised no more) or --max-iterations trials. Ceres also stops where
no entry of the gradient is above --gradient-tolerance; ours, which looks at angles instead, at a cosine of 1e-10.
COLMAP's own defaults are 0 (off), 1e-4 and 100. Ceres stops by
parameter_tolerance, too, which COLMAP leaves at 0 (off); ours stops at a step of 1e-14 of the parameters. The linear
solver of Ceres is the one that COLMAP picks (dense Schur up to 50 images, sparse up to 1,000, then iterative with
Schur–Jacobi), unless --ceres-solver says otherwise; below 50,000 residuals COLMAP gives Ceres one thread, which is
faster there.

Times are those of the one call a user makes, after one untimed step that compiles our kernels; Ceres' call is setting
up its problem and solving it. Ratios are medians over the repeats, the sides taking turns. Final costs are computed by
our code; they are compared (rel.) over the observations that still have a projection at the end of both, since Ceres
charges nothing for a point behind a camera. Peak memory is what a call adds to a process of its own. A row is as it
should be (cost, time, memory: yes) if our cost is at most theirs × (1 + 1e-6), our time at most 1/6 of theirs (1/3 with
more than 500 images) and our memory not more.

Of ../shared/data/ba, libmv's problem and gtsam's are left out: the one refines poses by a distortion model of its own,
the others have fewer equations than unknowns. The landmarks of fr1desk start on a plane (240 px), with several minima;
race it with --loss cauchy.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path

from scripts import bench_bundle_problems as problems
from scripts.bench_bundle_curves import Curve, curve_table, draw
from scripts.bench_bundle_race import LOSSES, SOLVERS, Outcome, Rules, curves, peak_memory_mb, race, run_side, warm_up
from sfm.bundle import BundleProblem

_COST_SLACK = 1e-6


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One problem, both sides. Memory in MB; what was not measured is None."""

    name: str
    intrinsics: str
    images: int
    points: int
    observations: int
    start_px: float
    outcome: Outcome
    our_memory_mb: float | None
    ceres_memory_mb: float | None
    curve: dict[str, Curve] | None = None

    @property
    def wanted_ratio(self) -> float:
        """How many times faster than Ceres we ought to be."""
        return 6.0 if self.images <= 500 else 3.0

    @property
    def holds(self) -> dict[str, bool | None]:
        """Whether cost, time and memory are as they should be; None where it was not measured."""
        cost = None if self.outcome.difference is None else self.outcome.difference <= _COST_SLACK
        time = None if self.outcome.ratio is None else self.outcome.ratio >= self.wanted_ratio
        both = self.our_memory_mb is not None and self.ceres_memory_mb is not None
        return {"cost": cost, "time": time, "memory": self.our_memory_mb <= self.ceres_memory_mb if both else None}  # type: ignore[operator]

    def __str__(self) -> str:
        ours, ceres, outcome = self.outcome.ours, self.outcome.ceres, self.outcome
        difference = "-" if outcome.difference is None else f"{outcome.difference:+.1e}"
        theirs = "-" if ceres is None else f"{ceres.seconds:.3f}"
        ratio = "-" if outcome.ratio is None else f"{outcome.ratio:.2f}"
        steps = f"{ours.iterations}" + ("" if ceres is None else f"/{ceres.iterations}")
        memory = "/".join("-" if m is None else f"{m:.0f}" for m in (self.our_memory_mb, self.ceres_memory_mb))
        holds = " ".join(f"{ {True: 'yes', False: 'NO', None: '-'}[value]:>4}" for value in self.holds.values())
        return (
            f"{self.name:30.30} {self.intrinsics:5} {self.images:5} {self.points:7} {self.observations:8} "
            f"{self.start_px:8.2f} {ours.cost:14.7e} {difference:>8} {ours.seconds:8.3f} {theirs:>8} "
            f"{ratio:>6} {steps:>7} {memory:>11} {holds}  {self._endings()}"
        )

    def _endings(self) -> str:
        sides = [side for side in (self.outcome.ours, self.outcome.ceres) if side is not None]
        lost = [f" ({side.without_projection} without projection)" * (side.without_projection > 0) for side in sides]
        return " | ".join(side.reason + words for side, words in zip(sides, lost, strict=True))

    def to_json(self) -> dict[str, object]:
        """All figures and what holds."""
        return {**dataclasses.asdict(self), "wanted_ratio": self.wanted_ratio, "holds": self.holds}


_HEAD = (
    f"{'problem':30} {'intr.':5} {'img':>5} {'points':>7} {'obs':>8} {'start px':>8} {'our cost':>14} {'rel.':>8} "
    f"{'ours s':>8} {'Ceres s':>8} {'ratio':>6} {'steps':>7} {'memory MB':>11} {'cost':>4} {'time':>4} {'mem.':>4}"
)


def parse() -> argparse.Namespace:
    """The command line; see the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", type=Path, metavar="PROBLEM")
    parser.add_argument("--synthetic", nargs="*", default=[], metavar="SIZE")
    parser.add_argument("--street", nargs="*", default=[], metavar="SIZE")
    parser.add_argument("--intrinsics", nargs="+", choices=["free", "fixed"], default=["free"])
    parser.add_argument("--fix-intrinsics", action="store_const", const=["fixed"], dest="intrinsics")
    parser.add_argument("--disturb", type=float, default=0.0, help="part of the distances, and radians")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--tolerance", type=float, default=1e-8)
    parser.add_argument("--gradient-tolerance", type=float, default=1e-4)
    parser.add_argument("--max-iterations", type=int, default=100)
    parser.add_argument("--loss", choices=list(LOSSES), default="trivial")
    parser.add_argument("--loss-scale", type=float, default=1.0)
    parser.add_argument("--ours", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of BundleConfig")
    parser.add_argument("--ceres-solver", choices=list(SOLVERS), default="auto")
    parser.add_argument("--ceres-too", action="store_true", help="on streets as well")
    parser.add_argument("--no-ceres", action="store_true", help="only our side")
    parser.add_argument("--no-memory", action="store_true", help="without the processes that measure it")
    parser.add_argument("--curve", action="store_true", help="cost against time, both sides, as a table")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="… and drawn")
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="keeps synthetic problems")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if not (args.problems or args.synthetic or args.street):
        args.synthetic = ["20x5000", "100x20000x10"]
    return args


def rules_of(args: argparse.Namespace) -> Rules:
    """What both sides are told."""
    return Rules(
        threads=args.threads,
        tolerance=args.tolerance,
        gradient_tolerance=args.gradient_tolerance,
        max_iterations=args.max_iterations,
        loss=args.loss,
        loss_scale=args.loss_scale,
        ceres_solver=args.ceres_solver,
        ours=tuple(tuple(item.split("=", 1)) for item in args.ours),
    )


def listed(args: argparse.Namespace) -> Iterator[tuple[str, BundleProblem, bool]]:
    """Name, problem and whether Ceres takes part."""
    for path in args.problems:
        problem = problems.read_problem(path)
        name = path.name
        if path.is_dir():
            name = "/".join(path.resolve().parts[-3:])
            problem = problems.disturbed(problem, args.disturb) if args.disturb else problem
        yield name, problem, not args.no_ceres
    for size in args.synthetic:
        yield size, problems.remembered("synthetic", size, args.cache), not args.no_ceres
    for size in args.street:
        yield f"street {size}", problems.remembered("street", size, args.cache), args.ceres_too and not args.no_ceres


def compare(name: str, problem: BundleProblem, rules: Rules, with_ceres: bool, args: argparse.Namespace) -> Row:
    """Runs both sides `args.repeats` times in turns, and what else was asked for."""
    warm_up(problem, rules)
    outcome = race(problem, rules, max(args.repeats, 1), with_ceres)
    sides = ("ours", "ceres") if with_ceres else ("ours",)
    memory = {} if args.no_memory else {side: peak_memory_mb(problem, rules, side) for side in sides}
    wanted = args.curve or args.plot is not None
    return Row(
        name=name,
        intrinsics="free" if problem.free_params.any() else "fixed",
        images=len(problem.free_poses),
        points=len(problem.free_points),
        observations=len(problem.obs_images),
        start_px=problems.start_error_px(problem),
        outcome=outcome,
        our_memory_mb=memory.get("ours"),
        ceres_memory_mb=memory.get("ceres"),
        curve=curves(problem, rules, sides) if wanted else None,
    )


def main() -> None:
    """Prints a row for each problem, or all rows as JSON."""
    if sys.argv[1:2] == ["--run-side"]:  # in the process that `peak_memory_mb` starts
        run_side(sys.argv[2:])
        return
    args = parse()
    rules, rows = rules_of(args), []
    with contextlib.suppress(BrokenPipeError):
        if not args.json:
            print(_HEAD)
        for name, problem, with_ceres in listed(args):
            for intrinsics in args.intrinsics:
                chosen = problem if intrinsics == "free" else problems.with_fixed_intrinsics(problem)
                rows.append(compare(name, chosen, rules, with_ceres, args))
                if not args.json:
                    print(rows[-1], flush=True)
                    if args.curve and rows[-1].curve is not None:
                        print(curve_table(rows[-1].curve), flush=True)
        if args.json:
            print(json.dumps([row.to_json() for row in rows], indent=2))
    if args.plot is not None:
        draw([(f"{row.name}, intrinsics {row.intrinsics}", row.curve) for row in rows if row.curve], args.plot)


if __name__ == "__main__":
    main()
