# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Work and precision: the largest energy error against the number of force evaluations, for every step control.

Every monitor is run with every update of the step density on the systems of `openmmvrattle.testsystems`, each at
several numbers of force evaluations, and compared at equal numbers (within 2 %) with RATTLE with fixed steps, which
differs from them in nothing but the steps, and with OpenMM's VerletIntegrator and VariableVerletIntegrator.

- gain: the largest energy error of RATTLE with fixed steps divided by that of the method, at equal force evaluations;
- evaluations saved: how many times as many evaluations RATTLE needs for the same largest energy error, read off its
  measured curve by interpolation in the logarithms; ``>`` where RATTLE was not measured down to that error.

Written to the folder ``--output``: measurements.jsonl (one line a measurement), table.csv, table.md and
work_precision.png. This is a measurement and not a test: it says for each claim of the project whether it was met,
and ends with exit code 0 either way.

    python benchmarks/work_precision.py --jobs 2            # everything, about ten minutes
    python benchmarks/work_precision.py --systems water-clash --monitors ForcePNorm^0.5 AppliedForce
    python benchmarks/work_precision.py --claims            # only what the claims need
    python benchmarks/work_precision.py --quick             # a short part of each run, for a look
"""

from __future__ import annotations

import argparse
import csv
import functools
import json
import math
import platform
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pages
from openmmvrattle.compare.comparison import compare, quick_settings, two_digits
from openmmvrattle.testsystems import SYSTEMS, MonitorSettings, StepControl, TestSystem
from PIL import Image

MONITORS: dict[str, MonitorSettings] = {
    setting.kind if setting.power == 1.0 else f"{setting.kind}^{setting.power:g}": setting
    for setting in (
        MonitorSettings("ConstraintMultipliers"),
        MonitorSettings("MultiplierPNorm"),
        MonitorSettings("ConstraintForce"),
        MonitorSettings("ConstraintAndAppliedForce"),
        MonitorSettings("AppliedForce"),
        MonitorSettings("ForcePNorm"),
        MonitorSettings("ForcePNorm", power=0.5),
        MonitorSettings("MaxForce"),
        MonitorSettings("VectorField"),
        MonitorSettings("ArcLength"),
        MonitorSettings("MaxParticleArcLength"),
    )
}
"""The monitors by the names under which the command line knows them. ForceGroupEnergy is left out: it is a function
that the user writes for one system, and these systems have no natural one."""
UPDATES = ("SemiExplicit", "Explicit", "Bounded")
DEFAULT_BOUNDS = (1 / 50, 2.0)
"""Smallest and largest step divided by the nominal one, as the integrator has them by default."""
INTEGRATORS = ("VerletIntegrator", "VariableVerletIntegrator", "RATTLE", "VRATTLE")
"""What is run: OpenMM's own, the control, and the step controls."""
QUICK_PART, QUICK_EVALUATIONS = 0.05, 100
"""With --quick: the part of each run that is kept, and the fewest evaluations that are left then."""


@dataclass(frozen=True)
class Problem:
    """How one system is run."""

    system: str
    evaluations: tuple[int, ...]
    """Numbers of force evaluations of all methods. Claims are judged at the last of them."""
    more_fixed_evaluations: tuple[int, ...] = ()
    """Further numbers for fixed steps only, so that their curve reaches smaller errors."""
    bounds: tuple[float, float] = DEFAULT_BOUNDS
    """Smallest and largest step divided by the nominal one, for all monitors; 0 for no bound."""
    calibrated_part: float = 0.0
    """The part of the evaluations spent on trial steps for the reference value; 0: the value at the first step."""
    varied: tuple[tuple[str, str], ...] = ()
    """Monitors and updates whose bounds and reference value are varied, at the last number of evaluations."""
    seeds: tuple[int, ...] = ()
    """Seeds of further starts, run at the last number of evaluations with the default bounds."""


VARIED_BOUNDS = (
    (1 / 20, 1.25),
    (1 / 50, 4 / 3),
    (1 / 50, 2.0),
    (1 / 50, 4.0),
    (1 / 100, 2.0),
    (1 / 100, 10.0),
    (1 / 100, 30.0),
    (0.0, 0.0),
)
VARIED_CALIBRATION = 1 / 16
SEEDED_MONITORS = ("ConstraintAndAppliedForce", "ConstraintMultipliers")
_SEEDS = tuple(range(1, 9))

PROBLEMS: dict[str, Problem] = {
    problem.system: problem
    for problem in (
        Problem(
            "double-pendulum",
            (4_000, 12_000, 40_000),
            more_fixed_evaluations=(100_000, 400_000),
            bounds=(1e-4, 10.0),
            varied=(("ConstraintForce", "SemiExplicit"), ("ConstraintMultipliers", "SemiExplicit")),
        ),
        Problem(
            "light-heavy-chain",
            (1_000, 4_000, 16_000),
            more_fixed_evaluations=(64_000, 256_000),
            bounds=(1 / 100, 10.0),
            varied=(("ConstraintForce", "Explicit"),),
        ),
        Problem(
            "light-heavy-chain-repulsion",
            (4_000, 8_000, 16_000),
            more_fixed_evaluations=(64_000, 256_000),
            bounds=(1 / 100, 1.5),
            calibrated_part=1 / 16,
            varied=(("ConstraintAndAppliedForce", "Explicit"),),
        ),
        Problem(
            "water-clash",
            (400, 800, 1_600),
            more_fixed_evaluations=(200, 3_200, 6_400),
            bounds=(1 / 100, 30.0),
            varied=(("ForcePNorm^0.5", "Explicit"),),
        ),
        Problem(
            "nitrogen-collision-5",
            (200, 400, 800),
            more_fixed_evaluations=(1_600, 3_200),
            bounds=(1 / 20, 1.25),
            varied=(("ForcePNorm^0.5", "Explicit"),),
        ),
        Problem(
            "nitrogen-collision-20",
            (200, 400, 800),
            more_fixed_evaluations=(1_600, 3_200),
            bounds=(1 / 20, 1.25),
            varied=(("ForcePNorm^0.5", "Explicit"),),
        ),
        Problem(
            "diatomic-on-wall",
            (200, 400, 800),
            more_fixed_evaluations=(1_600, 3_200),
            bounds=(1 / 20, 1.25),
            varied=(("ForcePNorm^0.5", "Explicit"),),
        ),
        Problem(
            "alanine-dipeptide-hbonds",
            (1_000, 2_000, 4_000),
            more_fixed_evaluations=(8_000,),
            varied=(("ConstraintAndAppliedForce", "SemiExplicit"), ("ConstraintMultipliers", "SemiExplicit")),
            seeds=_SEEDS,
        ),
        Problem("alanine-dipeptide-hbonds-1000-kelvin", (1_000, 2_000, 4_000), (8_000,), seeds=_SEEDS),
        Problem("rigid-waters", (1_000, 2_000, 4_000), (8_000,), seeds=_SEEDS),
        Problem("rigid-waters-32", (1_000, 1_500, 2_000), (4_000,), seeds=_SEEDS[:4]),
    )
}


@dataclass(frozen=True)
class Claim:
    """A gain that the project claims, with the settings that reach it."""

    name: str
    system: str
    monitor: str
    update: str
    bounds: tuple[float, float]
    evaluations: tuple[int, ...]
    least_gain: float
    calibrated_part: float = 0.0
    seeds: tuple[int, ...] = ()
    """Seeds of the starts; empty for the system's own. The mean over these and the evaluations is geometric."""


CLAIMS: dict[str, Claim] = {
    claim.name: claim
    for claim in (
        Claim("pendulum", "double-pendulum", "ConstraintForce", "SemiExplicit", (0.0, 0.0), (66_000,), 100_000.0),
        Claim("whip", "light-heavy-chain", "ConstraintForce", "Explicit", (1 / 100, 10.0), (16_000,), 1000.0),
        Claim(
            "whip-with-repulsion",
            "light-heavy-chain-repulsion",
            "ConstraintAndAppliedForce",
            "Explicit",
            (1 / 100, 1.5),
            (15_700, 15_850, 16_000, 16_150, 16_300),
            30.0,
            calibrated_part=1 / 16,
        ),
        Claim("water-clash", "water-clash", "ForcePNorm^0.5", "Explicit", (1 / 100, 30.0), (800,), 10.0),
        *(
            Claim(
                system,
                system,
                "ConstraintAndAppliedForce",
                "SemiExplicit",
                DEFAULT_BOUNDS,
                PROBLEMS[system].evaluations[-1:],
                0.9,
                seeds=PROBLEMS[system].seeds,
            )
            for system in PROBLEMS
            if PROBLEMS[system].seeds
        ),
    )
}


@dataclass(frozen=True)
class Task:
    """Runs of one system at one number of force evaluations: some step controls, and what they are compared with."""

    system: str
    seed: int | None
    evaluations: int
    monitors: tuple[str, ...] = ()
    """The monitor of each control."""
    controls: tuple[StepControl, ...] = ()
    study: str = "monitors"
    """``monitors`` for the comparison of all monitors, ``settings`` for varied bounds, ``starts`` for several seeds,
    ``claims`` for what only a claim needs."""
    part: float = 1.0
    """The part of the time and of the evaluations that is run."""


@dataclass(frozen=True)
class Measurement:
    """One integrator on one system; failed runs have no error and say why."""

    study: str
    system: str
    seed: int | None
    method: str
    """``fixed`` and ``variable``: OpenMM's own; ``control``: RATTLE with fixed steps; ``vrattle``: variable steps."""
    monitor: str
    update: str
    smallest_step_ratio: float
    largest_step_ratio: float
    calibration_steps: int
    evaluations: int
    """What was asked for."""
    force_evaluations: int
    """What was done."""
    largest_energy_error: float
    """kJ/mol"""
    rms_energy_error: float
    """kJ/mol"""
    gain: float
    parameter: float
    """Nominal step in ps, or the error tolerance of VariableVerletIntegrator."""
    smallest_step: float
    """ps"""
    largest_step: float
    """ps"""
    rescues: int
    seconds_per_step: float
    failure: str | None

    @property
    def curve(self) -> tuple[Any, ...]:
        """What the measurements of one curve of error against evaluations have in common."""
        return (
            self.system,
            self.method,
            self.monitor,
            self.update,
            self.smallest_step_ratio,
            self.largest_step_ratio,
            self.calibration_steps > 0,
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    options = _parse(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    measurements = _run_all(_tasks(options), options)
    seconds = time.perf_counter() - started
    _write_csv(measurements, options.output / "table.csv")
    report = "\n".join(_report(measurements))
    (options.output / "table.md").write_text(report + "\n", encoding="utf-8")
    if any(m.study == "monitors" for m in measurements):
        _draw(measurements, options.output / "work_precision.png")
    if options.page:
        _draw(measurements, pages.DOCS / "images" / "work_precision.png")
        pages.write(pages.DOCS / "work_precision.md", "work-precision", [pages.provenance(), "", report])
    print(report)
    print()
    for line in _judge(measurements, options):
        print(line)
    print(
        f"\n{len(measurements)} measurements in {seconds:.0f} s with {options.jobs} process(es), OpenMM "
        f"{openmm.Platform.getOpenMMVersion()}, {platform.machine()}; files are in {options.output}."
    )
    return 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n")[0], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--systems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), metavar="NAME")
    parser.add_argument("--monitors", nargs="+", choices=MONITORS, default=list(MONITORS), metavar="NAME")
    parser.add_argument("--updates", nargs="+", choices=UPDATES, default=list(UPDATES), metavar="NAME")
    parser.add_argument(
        "--evaluations", nargs="+", type=int, metavar="N", help="numbers of force evaluations (default: by system)"
    )
    parser.add_argument(
        "--claims",
        nargs="*",
        choices=CLAIMS,
        metavar="NAME",
        help="run only what these claims need (default: all of them): " + ", ".join(CLAIMS),
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of processes (default: 1)")
    parser.add_argument(
        "--quick", action="store_true", help="run a short part only; gains and claims are not those of the full runs"
    )
    parser.add_argument("--output", type=Path, default=Path("out/work-precision"), metavar="FOLDER")
    parser.add_argument("--page", action="store_true", help="put tables and figures into docs/work_precision.md")
    options = parser.parse_args(arguments)
    if options.page and (options.quick or options.claims is not None or options.evaluations):
        parser.error("a page shows a run of everything")
    if options.jobs < 1:
        parser.error("the number of jobs must be at least 1")
    if options.evaluations and min(options.evaluations) < 100:
        parser.error("the number of force evaluations must be at least 100")
    return options


# ---------------------------------------------------------------------------------------------------- what to run


def _tasks(options: argparse.Namespace) -> list[Task]:
    """All runs, the longest first so that several processes end together."""
    tasks = []
    if options.claims is not None:
        for name in options.claims or CLAIMS:
            tasks += _tasks_of_claim(CLAIMS[name])
    else:
        for name in options.systems:
            tasks += _tasks_of_problem(PROBLEMS[name], options)
            for claim in CLAIMS.values():
                is_chosen = claim.monitor in options.monitors and claim.update in options.updates
                if claim.system == name and is_chosen and not claim.seeds and not options.evaluations:
                    tasks += _tasks_of_claim(claim)
    if options.quick:
        fewest: dict[str, int] = {}
        for task in tasks:
            fewest[task.system] = min(task.evaluations, fewest.get(task.system, task.evaluations))
        tasks = [replace(task, part=max(QUICK_PART, QUICK_EVALUATIONS / fewest[task.system])) for task in tasks]
    return sorted(tasks, key=lambda task: task.evaluations * (1 + 3 * len(task.controls)), reverse=True)


def _tasks_of_problem(problem: Problem, options: argparse.Namespace) -> list[Task]:
    evaluations = options.evaluations or problem.evaluations
    tasks = []
    for number in evaluations:
        for update in options.updates:
            controls = tuple(
                _control(problem.system, monitor, update, problem.bounds, number, problem.calibrated_part)
                for monitor in options.monitors
            )
            tasks.append(Task(problem.system, None, number, tuple(options.monitors), controls))
    if not options.evaluations:
        tasks += [Task(problem.system, None, number) for number in problem.more_fixed_evaluations]
    last = evaluations[-1]
    for monitor, update in problem.varied:
        if monitor in options.monitors and update in options.updates:
            controls = _varied_controls(problem, monitor, update, last)
            tasks.append(Task(problem.system, None, last, (monitor,) * len(controls), controls, "settings"))
    for seed in problem.seeds:
        monitors = [monitor for monitor in SEEDED_MONITORS if monitor in options.monitors]
        pairs = [(monitor, update) for monitor in monitors for update in options.updates]
        controls = tuple(_control(problem.system, *pair, DEFAULT_BOUNDS, last) for pair in pairs)
        tasks.append(Task(problem.system, seed, last, tuple(monitor for monitor, _ in pairs), controls, "starts"))
    return tasks


def _varied_controls(problem: Problem, monitor: str, update: str, evaluations: int) -> tuple[StepControl, ...]:
    return tuple(
        _control(problem.system, monitor, update, bounds, evaluations, part)
        for part in (0.0, VARIED_CALIBRATION)
        for bounds in VARIED_BOUNDS
    )


def _tasks_of_claim(claim: Claim) -> list[Task]:
    tasks = []
    for number in claim.evaluations:
        control = _control(claim.system, claim.monitor, claim.update, claim.bounds, number, claim.calibrated_part)
        for seed in claim.seeds or (None,):
            study = "claims" if seed is None else "starts"
            tasks.append(Task(claim.system, seed, number, (claim.monitor,), (control,), study))
    return tasks


def _control(
    system: str, monitor: str, update: str, bounds: tuple[float, float], evaluations: int, calibrated_part: float = 0.0
) -> StepControl:
    return StepControl(
        monitors=(MONITORS[monitor],),
        nominal_step_size=_test_system(system, None).settings.total_time / evaluations,
        smallest_step_ratio=bounds[0],
        largest_step_ratio=bounds[1],
        update_method=update,
        calibration_steps=round(calibrated_part * evaluations),
    )


@functools.lru_cache(maxsize=4)
def _test_system(name: str, seed: int | None) -> TestSystem:
    return SYSTEMS[name]() if seed is None else SYSTEMS[name](seed=seed)


# --------------------------------------------------------------------------------------------------------- the runs


def _run_all(tasks: list[Task], options: argparse.Namespace) -> list[Measurement]:
    measurements: dict[tuple[Any, ...], Measurement] = {}
    with (options.output / "measurements.jsonl").open("w", encoding="utf-8") as file:
        for done, results in enumerate(_results(tasks, options.jobs), 1):
            for measurement in results:
                key = (*measurement.curve, measurement.study, measurement.seed, measurement.evaluations)
                # Tasks of one system repeat the integrators with which theirs are compared.
                if key not in measurements:
                    measurements[key] = measurement
                    file.write(json.dumps(_without_nan(asdict(measurement))) + "\n")
            file.flush()
            print(f"\r{done} of {len(tasks)} tasks", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    order = {name: index for index, name in enumerate([*PROBLEMS])}
    return sorted(measurements.values(), key=lambda m: (order[m.system], m.study, m.seed or 0, m.evaluations))


def _results(tasks: list[Task], jobs: int) -> Iterable[list[Measurement]]:
    if jobs == 1:
        yield from map(_run, tasks)
        return
    with ProcessPoolExecutor(jobs) as pool:
        for future in as_completed([pool.submit(_run, task) for task in tasks]):
            yield future.result()


def _run(task: Task) -> list[Measurement]:
    test_system = _test_system(task.system, task.seed)
    settings = replace(test_system.settings, force_evaluations=task.evaluations, controls=task.controls)
    if task.part < 1.0:
        calibrations = (round(control.calibration_steps * task.part) for control in task.controls)
        controls = tuple(
            replace(control, calibration_steps=steps)
            for control, steps in zip(task.controls, calibrations, strict=True)
        )
        settings = replace(quick_settings(settings, task.part, fewest=1), controls=controls)
    comparison = compare(test_system, settings=settings, integrators=INTEGRATORS)
    measurements = []
    for index, run in enumerate(comparison.runs):
        # The first three runs are Verlet, VariableVerlet and RATTLE with fixed steps.
        control = settings.controls[index - 3] if index >= 3 else None
        measurements.append(
            Measurement(
                study=task.study,
                system=task.system,
                seed=task.seed,
                method=run.method,
                monitor=task.monitors[index - 3] if control else "",
                update=control.update_method if control else "",
                smallest_step_ratio=control.smallest_step_ratio if control else math.nan,
                largest_step_ratio=control.largest_step_ratio if control else math.nan,
                calibration_steps=control.calibration_steps if control else 0,
                evaluations=settings.force_evaluations,
                force_evaluations=run.force_evaluations,
                largest_energy_error=run.largest_energy_error if run.failure is None else math.nan,
                rms_energy_error=run.rms_energy_error if run.failure is None else math.nan,
                gain=comparison.gain(run),
                parameter=run.parameter,
                smallest_step=run.smallest_step,
                largest_step=run.largest_step,
                rescues=run.rescues,
                seconds_per_step=run.seconds_per_step,
                failure=run.failure,
            )
        )
    return measurements


def _without_nan(values: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }


# ------------------------------------------------------------------------------------------------------ the numbers


def evaluations_saved(
    fixed: Sequence[tuple[float, float]], variable: Sequence[tuple[float, float]]
) -> tuple[float, bool] | None:
    """How many times as many force evaluations fixed steps need for the errors of variable ones.

    Fixed steps are interpolated in the logarithms of errors and evaluations, never extrapolated.

    Args:
        fixed: numbers of evaluations and largest energy errors of fixed steps.
        variable: the same of variable steps.

    Returns:
        The geometric mean over the points of variable steps whose error lies among those of fixed steps, and False; or,
        where all errors are smaller than any of fixed steps, the largest ratio that is certain, and True; or None.
    """
    fixed = sorted(fixed)
    # The error as a falling function of the evaluations, so that the reading is unique.
    errors = np.minimum.accumulate([error for _, error in fixed]) if fixed else np.array([])
    numbers = np.array([number for number, _ in fixed], dtype=float)
    inside, beyond = [], []
    for number, error in variable:
        if not len(errors) or not math.isfinite(error):
            continue
        if error < errors[-1]:
            beyond.append(numbers[-1] / number)
        elif error <= errors[0]:
            needed = math.exp(np.interp(-math.log(error), -np.log(errors), np.log(numbers)))
            inside.append(needed / number)
    if inside:
        return float(np.exp(np.mean(np.log(inside)))), False
    return (max(beyond), True) if beyond else None


def _points(measurements: Iterable[Measurement]) -> list[tuple[float, float]]:
    return sorted(
        (m.force_evaluations, m.largest_energy_error) for m in measurements if math.isfinite(m.largest_energy_error)
    )


def _geometric_mean(values: Sequence[float]) -> float:
    """NaN if any value is."""
    return math.exp(sum(map(math.log, values)) / len(values)) if values else math.nan


def _gain_of_claim(claim: Claim, measurements: Sequence[Measurement]) -> float:
    """The mean gain, or NaN if a run of the claim is missing or has failed."""
    gains = {
        (m.evaluations, m.seed): m.gain
        for m in measurements
        if (m.system, m.monitor, m.update) == (claim.system, claim.monitor, claim.update)
        and (m.smallest_step_ratio, m.largest_step_ratio) == claim.bounds
        and m.calibration_steps == round(claim.calibrated_part * m.evaluations)
    }
    wanted = [(number, seed) for number in claim.evaluations for seed in claim.seeds or (None,)]
    return _geometric_mean([gains.get(run, math.nan) for run in wanted])


def _judge(measurements: Sequence[Measurement], options: argparse.Namespace) -> list[str]:
    """One line for each claim: the gain, what is claimed, and whether it was met."""
    lines = []
    results = []
    for claim in CLAIMS.values():
        # A part of a run says nothing about the whole.
        gain = math.nan if options.quick else _gain_of_claim(claim, measurements)
        if not any(m.system == claim.system for m in measurements):
            continue
        words = "not measured" if math.isnan(gain) else "met" if gain >= claim.least_gain else "MISSED"
        runs = len(claim.evaluations) * max(1, len(claim.seeds))
        mean = f", mean of {runs} runs" if runs > 1 else ""
        results.append({"claim": claim.name, "gain": gain, "least_gain": claim.least_gain, "verdict": words})
        lines.append(
            f"claim {claim.name}: {claim.monitor}, {claim.update}, {claim.evaluations[-1]:,} evaluations{mean}: gain "
            f"{two_digits(gain)}, at least {two_digits(claim.least_gain)} claimed: {words}"
        )
    with (options.output / "claims.jsonl").open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(_without_nan(result)) + "\n" for result in results)
    return lines


# ---------------------------------------------------------------------------------------------------- files, figure


def _write_csv(measurements: Sequence[Measurement], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(Measurement.__dataclass_fields__))
        writer.writeheader()
        writer.writerows(asdict(measurement) for measurement in measurements)


def _report(measurements: Sequence[Measurement]) -> list[str]:
    """Tables in Markdown: for each system the monitors, then the varied settings and the starts."""
    lines: list[str] = []
    for system in dict.fromkeys(m.system for m in measurements):
        own = [m for m in measurements if m.system == system]
        lines += [f"### {system}", ""]
        for study, table in (("monitors", _monitor_table), ("settings", _settings_table), ("starts", _starts_table)):
            chosen = [m for m in own if m.study == study]
            if chosen:
                lines += [*table(chosen), ""]
    return lines[:-1]


def _monitor_table(measurements: Sequence[Measurement]) -> list[str]:
    varied = [m for m in measurements if m.method == "vrattle"]
    fixed = [m for m in measurements if m.method == "control"]
    lines = ["| evaluations | RATTLE, fixed steps | VerletIntegrator | VariableVerletIntegrator |", "|---|---|---|---|"]
    for number in sorted({m.evaluations for m in measurements}):
        row = {m.method: m.largest_energy_error for m in measurements if m.evaluations == number}
        cells = (two_digits(row[method]) for method in ("control", "fixed", "variable"))
        lines.append(f"| {number:,} | " + " | ".join(cells) + " |")
    if not varied:
        return lines
    numbers = sorted({m.evaluations for m in varied})
    updates = [update for update in UPDATES if any(m.update == update for m in varied)]
    part = max(m.calibration_steps / m.evaluations for m in varied)
    reference = f"calibrated with 1/{1 / part:.0f} of the evaluations" if part else "reference value U at the start"
    heading = (
        f"Gains at {', '.join(f'{n:,}' for n in numbers)} evaluations; {_bounds_in_words(varied[0])}; {reference}:"
    )
    lines += ["", heading, ""]
    lines.append("| monitor | " + " | ".join(updates) + " | evaluations saved |")
    lines.append("|---" * (len(updates) + 2) + "|")
    for monitor in dict.fromkeys(m.monitor for m in varied):
        cells, saved = [], []
        for update in updates:
            curve = {m.evaluations: m for m in varied if (m.monitor, m.update) == (monitor, update)}
            cells.append(", ".join(_gain_in_words(curve[number]) for number in numbers))
            saved.append(evaluations_saved(_points(fixed), _points(curve.values())))
        lines.append(f"| {monitor} | " + " | ".join(cells) + f" | {', '.join(map(_saved_in_words, saved))} |")
    return lines


def _settings_table(measurements: Sequence[Measurement]) -> list[str]:
    lines = []
    varied = [m for m in measurements if m.method == "vrattle"]
    for monitor, update in dict.fromkeys((m.monitor, m.update) for m in varied):
        own = [m for m in varied if (m.monitor, m.update) == (monitor, update)]
        calibration = max(m.calibration_steps for m in own)
        lines += ["", f"Gains of {monitor} ({update}) with other bounds, {own[0].evaluations:,} evaluations:", ""]
        lines.append(f"| bounds | U at the start | calibrated with {calibration:,} trial steps |")
        lines.append("|---|---|---|")
        for bounds in dict.fromkeys((m.smallest_step_ratio, m.largest_step_ratio) for m in own):
            row = [m for m in own if (m.smallest_step_ratio, m.largest_step_ratio) == bounds]
            cells = (_gain_in_words(m) for m in sorted(row, key=lambda m: m.calibration_steps))
            lines.append(f"| {_bounds_in_words(row[0])} | " + " | ".join(cells) + " |")
    return lines[1:]


def _starts_table(measurements: Sequence[Measurement]) -> list[str]:
    varied = [m for m in measurements if m.method == "vrattle"]
    lines = ["| monitor | update | starts | mean gain | from, to |", "|---|---|---|---|---|"]
    for monitor, update in dict.fromkeys((m.monitor, m.update) for m in varied):
        gains = [m.gain for m in varied if (m.monitor, m.update) == (monitor, update)]
        low, high = min(gains), max(gains)
        lines.append(
            f"| {monitor} | {update} | {len(gains)} | {two_digits(_geometric_mean(gains))} | "
            f"{two_digits(low)}, {two_digits(high)} |"
        )
    return lines


def _gain_in_words(measurement: Measurement) -> str:
    if measurement.failure is not None:
        return "fails"
    return two_digits(measurement.gain) if math.isfinite(measurement.gain) else "runs"


def _saved_in_words(saved: tuple[float, bool] | None) -> str:
    if saved is None:
        return "-"
    ratio, is_bound = saved
    return f"> {two_digits(ratio)}" if is_bound else two_digits(ratio)


def _bounds_in_words(measurement: Measurement) -> str:
    smallest, largest = measurement.smallest_step_ratio, measurement.largest_step_ratio
    words = [
        f"smallest step 1/{1 / smallest:,.0f}" if smallest else "no smallest step",
        f"largest {largest:.3g} times the nominal" if largest else "no largest step",
    ]
    return ", ".join(words)


# Colours that can be told apart with any colour vision (Okabe and Ito); the less successful monitors are grey.
_STYLES: dict[str, dict[str, Any]] = {
    "control": {"label": "RATTLE, fixed steps", "color": "black", "linewidth": 2.2, "linestyle": "--"},
    "fixed": {"label": "VerletIntegrator", "color": "#E69F00", "linewidth": 3.5, "alpha": 0.6},
    "variable": {"label": "VariableVerletIntegrator", "color": "#56B4E9", "linewidth": 2.0},
    "ConstraintMultipliers": {"color": "#D55E00", "marker": "o"},
    "ConstraintForce": {"color": "#0072B2", "marker": "s"},
    "ConstraintAndAppliedForce": {"color": "#009E73", "marker": "D"},
    "ForcePNorm^0.5": {"color": "#CC79A7", "marker": "^"},
    "MultiplierPNorm": {"color": "#888888", "marker": "x"},
    "AppliedForce": {"color": "#888888", "marker": "+"},
    "ForcePNorm": {"color": "#888888", "marker": "1"},
    "MaxForce": {"color": "#888888", "marker": "2"},
    "VectorField": {"color": "#888888", "marker": "3"},
    "ArcLength": {"color": "#888888", "marker": "4"},
    "MaxParticleArcLength": {"color": "#888888", "marker": "|"},
}


def _draw(measurements: Sequence[Measurement], path: Path) -> None:
    """One panel for each system, with the update Explicit, or the first one that was run."""
    from matplotlib.figure import Figure

    chosen = [m for m in measurements if m.study == "monitors" and m.seed is None]
    systems = list(dict.fromkeys(m.system for m in chosen))
    columns = min(3, len(systems))
    rows = math.ceil(len(systems) / columns)
    updates = [update for update in UPDATES if any(m.update == update for m in chosen)]
    update = "Explicit" if "Explicit" in updates or not updates else updates[0]
    figure = Figure(figsize=(max(6.0, 4.0 * columns), 3.0 * rows + 1.6), dpi=85, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flat
    handles: dict[str, Any] = {}
    for index, (system, axes) in enumerate(zip(systems, panels, strict=False)):
        for name, style in _STYLES.items():
            points = _points(
                m
                for m in chosen
                if m.system == system and (m.method == name or (m.monitor == name and m.update == update))
            )
            if not points:
                continue
            is_grey = style["color"] == "#888888"
            drawn = {"linewidth": 0.7 if is_grey else 1.6, "markersize": 5, "zorder": 1.5 if is_grey else 2.5} | style
            label = drawn.pop("label", name)
            (handles[label],) = axes.plot(*zip(*points, strict=True), **drawn)
        axes.set_yscale("log")
        _number_evaluations(axes)
        if index + columns >= len(systems):
            axes.set_xlabel("force evaluations")
        axes.set_title(system, fontsize=10)
        axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
    for axes in list(panels):
        axes.set_visible(False)
    figure.supylabel("largest energy error (kJ/mol)", fontsize=10)
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.suptitle(f"Work and precision (update {update}); a missing point is a failed run", fontsize=11)
    figure.savefig(path)
    with Image.open(path) as picture:  # 256 colours do, at a third of the size
        reduced = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    reduced.save(path, optimize=True)


def _number_evaluations(axes: Any) -> None:
    """Logarithms along the axis and plain numbers below it."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 50.0 * low else (1.0, 2.0, 4.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda number, _: f"{number:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=8)


if __name__ == "__main__":
    sys.exit(main())
