"""The two sides of `bench_bundle`: one call of each, their times, their memory, and their cost against time."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from pycolmap import pyceres

from scripts.bench_bundle_curves import Curve
from scripts.bench_bundle_problems import (
    load,
    reconstruction_of,
    save,
    synthesize,
    with_fixed_intrinsics,
    with_parameters_of,
)
from sfm.bundle import BundleConfig, BundleProblem, adjust, squared_errors
from sfm.core.optim import evaluate_loss

LOSSES = {
    "trivial": pycolmap.LossFunctionType.TRIVIAL,
    "huber": pycolmap.LossFunctionType.HUBER,
    "soft_l1": pycolmap.LossFunctionType.SOFT_L1,
    "cauchy": pycolmap.LossFunctionType.CAUCHY,
}
SOLVERS = {
    "auto": None,
    "dense": pyceres.LinearSolverType.DENSE_SCHUR,
    "sparse": pyceres.LinearSolverType.SPARSE_SCHUR,
    "iterative": pyceres.LinearSolverType.ITERATIVE_SCHUR,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rules:
    """What both sides are told; see `bench_bundle`."""

    threads: int
    tolerance: float
    gradient_tolerance: float
    max_iterations: int
    loss: str
    loss_scale: float
    ceres_solver: str
    ours: tuple[tuple[str, str], ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Side:
    """How one side ended, the observations that then had no projection, and the median time of its call."""

    cost: float
    seconds: float
    iterations: int
    reason: str
    without_projection: int


def config_of(rules: Rules) -> BundleConfig:
    """Our settings."""
    config = BundleConfig(
        loss=rules.loss, loss_scale_px=rules.loss_scale,  # type: ignore[arg-type]
        relative_cost_tolerance=rules.tolerance, max_iterations=rules.max_iterations,
    )  # fmt: skip
    as_before = {name: type(getattr(config, name)) for name, _ in rules.ours}
    return dataclasses.replace(config, **{name: as_before[name](value) for name, value in rules.ours})


def ceres_options(rules: Rules, refine_intrinsics: bool) -> pycolmap.BundleAdjustmentOptions:
    """What makes Ceres do the same."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = refine_intrinsics
    options.ceres.loss_function_type, options.ceres.loss_function_scale = LOSSES[rules.loss], rules.loss_scale
    solver = options.ceres.solver_options
    solver.function_tolerance, solver.gradient_tolerance = rules.tolerance, rules.gradient_tolerance
    solver.max_num_iterations, solver.num_threads = rules.max_iterations, rules.threads
    if SOLVERS[rules.ceres_solver] is not None:
        options.ceres.auto_select_solver_type = False
        solver.linear_solver_type = SOLVERS[rules.ceres_solver]
        solver.preconditioner_type = pyceres.PreconditionerType.SCHUR_JACOBI
    return options


def ceres_adjust(
    reconstruction: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions
) -> pyceres.SolverSummary:
    """What `pycolmap.bundle_adjustment` does, which tells nothing, less its lines in the log."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    return adjuster.solve().ceres_summary  # type: ignore[attr-defined]


def warm_up(problem: BundleProblem, rules: Rules) -> None:
    """Compiles our kernels, those that only this problem needs as well."""
    adjust(problem, dataclasses.replace(config_of(rules), max_iterations=1), threads=rules.threads)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """Both sides, how many times slower Ceres was, and by which part of Ceres' cost ours is higher.

    Ceres charges nothing for an observation that has no projection any more, and sometimes takes advantage of that;
    ours charges it dearly. The costs are therefore compared over what has a projection at both ends.
    """

    ours: Side
    ceres: Side | None = None
    ratio: float | None = None
    difference: float | None = None


def race(problem: BundleProblem, rules: Rules, repeats: int, with_ceres: bool) -> Outcome:
    """Both sides in turns: the last result of each with the median time, and the median of theirs over ours."""
    config, options = config_of(rules), ceres_options(rules, bool(problem.free_params.any()))
    start = reconstruction_of(problem) if with_ceres else None
    ours, theirs = [], []
    result = final = summary = None
    for _ in range(repeats):
        began = time.perf_counter()
        result = adjust(problem, config, threads=rules.threads)
        ours.append(time.perf_counter() - began)
        if start is not None:
            final = pycolmap.Reconstruction(start)
            began = time.perf_counter()
            summary = ceres_adjust(final, options)
            theirs.append(time.perf_counter() - began)
    assert result is not None
    our_side = Side(
        cost=result.final_cost, seconds=statistics.median(ours), iterations=result.iterations, reason=result.reason,
        without_projection=int(np.isnan(squared_errors(result.problem)).sum()),
    )  # fmt: skip
    if final is None or summary is None:
        return Outcome(ours=our_side)
    errors, their_errors = squared_errors(result.problem), squared_errors(with_parameters_of(problem, final))
    common = np.isfinite(errors) & np.isfinite(their_errors)
    cost = _cost(their_errors, rules)
    ceres = Side(
        cost=cost, seconds=statistics.median(theirs),
        iterations=summary.num_linear_solves, reason=_reason(summary),  # the last, too small trial is in no table
        without_projection=int(np.isnan(their_errors).sum()),
    )  # fmt: skip
    return Outcome(
        ours=our_side,
        ceres=ceres,
        ratio=statistics.median(t / o for o, t in zip(ours, theirs, strict=True)),
        difference=_cost(errors[common], rules) / _cost(their_errors[common], rules) - 1,
    )


def _cost(squared: np.ndarray, rules: Rules) -> float:
    """½ Σ ρ of squared residuals in px²; those that are NaN count nothing."""
    rho, _ = evaluate_loss(rules.loss, squared[np.isfinite(squared)], rules.loss_scale)  # type: ignore[arg-type]
    return 0.5 * float(rho.sum())


def _reason(summary: pyceres.SolverSummary) -> str:
    """`function`, `gradient`, … and the linear solver with its threads."""
    solver = summary.linear_solver_type_used.name.lower()
    word = summary.message.split(" tolerance")[0].lower() if "tolerance" in summary.message else summary.message[:24]
    return f"{word}, {solver}, {summary.num_threads_used} thr."


# --- cost against time ---


def curves(problem: BundleProblem, rules: Rules, sides: Sequence[str]) -> dict[str, Curve]:
    """Seconds since the call and cost at that time, the start included, of each side."""
    found = {"ours": _our_curve(problem, rules)}
    if "ceres" in sides:
        found["ceres"] = _ceres_curve(problem, rules)
    return found


def _our_curve(problem: BundleProblem, rules: Rules) -> Curve:
    """By the clock of the result's table if it has one, else by runs that end after 0, 1, 2, … trials."""
    config = config_of(rules)
    result = adjust(problem, config, threads=rules.threads)
    if hasattr(result.table[0], "seconds"):
        return [(float(row.seconds), row.cost) for row in result.table]  # type: ignore[attr-defined]
    curve: Curve = []
    for trials in range(result.iterations, -1, -1):
        began = time.perf_counter()
        part = adjust(problem, dataclasses.replace(config, max_iterations=trials), threads=rules.threads)
        seconds = time.perf_counter() - began
        # What disturbs the machine must not make fewer trials take longer than more.
        curve.append((min(seconds, curve[-1][0]) if curve else seconds, part.final_cost))
    return curve[::-1]


def _ceres_curve(problem: BundleProblem, rules: Rules) -> Curve:
    """From the table that Ceres prints; before its clock starts lies the setting up of the problem."""
    options = ceres_options(rules, bool(problem.free_params.any()))
    options.ceres.solver_options.minimizer_progress_to_stdout = True
    options.ceres.solver_options.logging_type = pyceres.LoggingType.PER_MINIMIZER_ITERATION
    reconstruction = reconstruction_of(problem)
    with _captured_stdout() as lines:
        began = time.perf_counter()
        summary = ceres_adjust(reconstruction, options)
        before = time.perf_counter() - began - summary.total_time_in_seconds
    rows = [line.split() for line in lines if line.split()[:1] and line.split()[0].isdigit()]
    reached = itertools.accumulate((float(row[1]) for row in rows), min)  # a refused step prints the cost it had
    return [(before + float(row[9]), cost) for row, cost in zip(rows, reached, strict=True)]


@contextlib.contextmanager
def _captured_stdout() -> Iterator[list[str]]:
    """The lines that C++ code writes to the standard output meanwhile, filled in at the end."""
    lines: list[str] = []
    sys.stdout.flush()
    libc, kept = ctypes.CDLL(None), os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        try:
            yield lines
        finally:
            libc.fflush(None)
            os.dup2(kept, 1)
            os.close(kept)
            file.seek(0)
            lines += file.read().decode().splitlines()


# --- memory ---


def peak_memory_mb(problem: BundleProblem, rules: Rules, side: str) -> float:
    """What one call of `side` adds at its peak to the resident memory of a process that holds the problem."""
    with tempfile.TemporaryDirectory() as folder:
        path, root = Path(folder) / "problem.npz", Path(__file__).resolve().parent.parent
        save(problem, path)
        command = [
            sys.executable,
            "-m",
            "scripts.bench_bundle",
            "--run-side",
            side,
            str(path),
            json.dumps(dataclasses.asdict(rules)),
        ]
        return float(subprocess.run(command, check=True, cwd=root, stdout=subprocess.PIPE, text=True).stdout)


def run_side(words: Sequence[str]) -> None:
    """Prints the figure of `peak_memory_mb`, in the process that this starts."""
    side, path, told = words
    rules = Rules(**json.loads(told))
    problem = load(Path(path))
    config, options = config_of(rules), ceres_options(rules, bool(problem.free_params.any()))
    small = synthesize(3, 40)
    small = small if problem.free_params.any() else with_fixed_intrinsics(small)
    warm_up(small, rules)
    ceres_adjust(reconstruction_of(small), options)
    reconstruction = reconstruction_of(problem) if side == "ceres" else None
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what building the model has freed would hide what the call takes
    before = _status_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    if reconstruction is None:
        adjust(problem, config, threads=rules.threads)
    else:
        ceres_adjust(reconstruction, options)
    print(max(_status_mb("VmHWM") - before, 0.0))


def _status_mb(key: str) -> float:
    """A figure of /proc/self/status in MB of 10⁶ bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) * 1.024e-3
    raise OSError(f"/proc/self/status has no {key}")
