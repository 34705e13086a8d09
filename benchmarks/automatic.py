# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What automatic step control gains over fixed steps, on systems where something happens and on calm ones.

    python benchmarks/automatic.py [--systems NAME ...] [--starts N] [--copies N] [--longer F] [--jobs N] [--quick]

The gain is the largest energy error of RATTLE with fixed steps divided by that with automatic step control, over the
same time and with the same number of force evaluations, of which both take one a step: the nominal step is adjusted
until this number is about the wanted one, but to no more than four times the mean step, and fixed steps get as many.

Energy errors of chaotic motions scatter, so every number is the geometric mean over several starts: other seeds of
thermal systems, other velocities (by a fiftieth of their size, at random) of the mechanical ones. In runs so long that
two of them part, that takes more runs still: --copies of each start, with velocities that differ by a millionth, and
--longer runs with as many more steps.

Prints a table and one line of JSON for each system and number of steps, writes automatic.jsonl, gains.png and
monitors.png, and says whether the gain falls below what the project claims; exit code 1 if it does.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import openmm
import pages
from matplotlib.figure import Figure
from openmm import app
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import (
    TestSystem,
    alanine_dipeptide,
    argon_cluster,
    colliding_water_clusters,
    diatomic_on_wall,
    double_pendulum,
    flexible_waters,
    independent_whips,
    ion_pair,
    light_heavy_chain,
    long_light_heavy_chain,
    nitrogen_collision,
    peptide_in_water,
    polymer,
    project_onto_constraints,
    rigid_waters,
    water_clash,
)

TOLERANCE = 1e-10  # of the constraints, relative
NEAR = 0.1  # the number of steps may differ by this fraction from the wanted one
MOST_TRIES = 6
LONGEST_STEP = 4.0  # of nominal steps, relative to the mean step that is wanted: nobody would choose a longer one
LEAST_GAIN = 0.95  # on every system
DISTURBANCE = 0.02  # of the velocities of a mechanical system, relative to their root mean square
COPY_DISTURBANCE = 1e-6  # of each velocity, relative, in the copies of a start


@dataclass(frozen=True)
class Problem:
    """One system, and how it is run."""

    name: str
    build: Callable[..., TestSystem]
    total_time: float
    """ps"""
    steps: tuple[int, int]
    takes_seed: bool = False
    """Whether `build` makes another start for each seed; if not, the velocities are disturbed."""
    least_gain: float = LEAST_GAIN
    is_own: bool = False
    """Whether it was added to those on which the method was found."""


PROBLEMS: dict[str, Problem] = {
    problem.name: problem
    for problem in (
        Problem("whip", light_heavy_chain, 20.0, (4_000, 16_000), least_gain=150),
        Problem("whip, repulsion", functools.partial(light_heavy_chain, True), 20.0, (16_000, 32_000), least_gain=15),
        Problem("long light-heavy chain", long_light_heavy_chain, 5.0, (16_000, 32_000), takes_seed=True),
        Problem("water clash", water_clash, 0.2, (800, 1_600), least_gain=25),
        Problem("N2 + N2, 5 km/s", nitrogen_collision, 0.4, (800, 1_600), least_gain=3),
        Problem("N2 + N2, 20 km/s", functools.partial(nitrogen_collision, 20.0), 0.1, (800, 1_600), least_gain=3),
        Problem("N2 on a wall, 5 km/s", functools.partial(diatomic_on_wall, 5.0), 0.4, (800, 1_600), least_gain=3),
        Problem("N2 on a wall, 10 km/s", functools.partial(diatomic_on_wall, 10.0), 0.2, (800, 1_600), least_gain=3),
        Problem("ion pair", ion_pair, 3.0, (2_000, 4_000), least_gain=3),
        Problem("8 waters", rigid_waters, 2.0, (1_000, 4_000), takes_seed=True),
        Problem("32 waters", functools.partial(rigid_waters, 32), 0.5, (400, 800), takes_seed=True),
        Problem("alanine dipeptide, 300 K", alanine_dipeptide, 2.0, (1_000, 4_000), takes_seed=True),
        Problem(
            "alanine dipeptide, 1000 K",
            functools.partial(alanine_dipeptide, temperature=1000.0),
            2.0,
            (1_400, 4_000),
            takes_seed=True,
        ),
        Problem("colliding water clusters", colliding_water_clusters, 1.0, (1_000, 4_000), takes_seed=True),
        Problem("64 independent whips", independent_whips, 5.0, (4_000, 8_000), takes_seed=True),
        Problem("double pendulum", double_pendulum, 12.0, (40_000, 80_000), is_own=True),
        Problem("peptide in water", peptide_in_water, 0.3, (300, 600), takes_seed=True, is_own=True),
        Problem("polymer", polymer, 4.0, (2_000, 4_000), takes_seed=True, is_own=True),
        Problem("argon cluster", argon_cluster, 5.0, (300, 1_000), takes_seed=True, is_own=True),
        Problem("flexible waters", flexible_waters, 0.5, (1_000, 2_000), takes_seed=True, is_own=True),
        Problem(
            "alanine dipeptide, rigid bonds",
            functools.partial(alanine_dipeptide, app.AllBonds),
            2.0,
            (1_000, 4_000),
            takes_seed=True,
            is_own=True,
        ),
    )
}


@dataclass(frozen=True)
class Run:
    """One run of one system from one start."""

    steps: int
    error: float
    """The largest energy error, kJ/mol; infinite if the run failed."""
    nominal_step: float
    largest_density: float


@dataclass(frozen=True)
class Result:
    """One system at one number of steps; gains are geometric means over the starts."""

    system: str
    wanted_steps: int
    steps: float
    """The mean of what was taken, geometric as all others."""
    starts: int
    gain: float
    smallest_gain: float
    largest_gain: float
    gain_error: float
    """The standard error of the gain, relative."""
    fixed_error: float
    """kJ/mol, geometric mean"""
    automatic_error: float
    largest_density: float
    fixed_failures: int
    """Starts from which fixed steps did not reach the end; they are left out of the means."""


def copy_of(start: TestSystem, number: int) -> TestSystem:
    """The start itself as number 0, or with velocities that differ a little."""
    if number == 0:
        return start
    random = np.random.default_rng(number)
    velocities = start.velocities * (1 + COPY_DISTURBANCE * random.standard_normal(start.velocities.shape))
    positions, velocities = project_onto_constraints(start.system, start.positions, velocities)
    return TestSystem(**{**vars(start), "positions": positions, "velocities": velocities})


def start_of(problem: Problem, seed: int) -> TestSystem:
    """The system from one of its starts."""
    if problem.takes_seed:
        return problem.build(seed=seed)
    start = problem.build()
    if seed == 1:
        return start
    random = np.random.default_rng(seed)
    speed = math.sqrt(float(np.mean(start.velocities**2))) or 0.1
    disturbed = start.velocities + DISTURBANCE * speed * random.standard_normal(start.velocities.shape)
    masses = np.array([start.system.getParticleMass(i)._value for i in range(len(start.positions))])
    disturbed[masses > 1e10] = 0.0  # the pivot of a pendulum
    positions, velocities = project_onto_constraints(start.system, start.positions, disturbed)
    return TestSystem(**{**vars(start), "positions": positions, "velocities": velocities})


def energy_of(context: openmm.Context) -> float:
    state = context.getState(energy=True)
    return state.getKineticEnergy()._value + state.getPotentialEnergy()._value


def run(start: TestSystem, total_time: float, step: float, automatic: bool, most_steps: int) -> Run:
    """Run to the end, or until there have been too many steps; a run that is given up counts those it would take."""
    integrator = VariableStepRattleIntegrator(step, constraintTolerance=TOLERANCE)
    if automatic:
        integrator.useAutomaticStepControl()
    else:
        integrator.clearMonitors()
    context = openmm.Context(start.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(start.positions)
    context.setVelocities(start.velocities)
    first = energy_of(context)
    worst, steps, largest = 0.0, 0, 0.0

    def remaining() -> float:
        # The last step is the one that ends nearest to the time.
        return total_time - context.getTime()._value - 0.5 * integrator.getStepSize()._value

    try:
        while remaining() > 0 and steps < most_steps:
            integrator.step(1)
            steps += 1
            worst = max(worst, abs(energy_of(context) - first))
            largest = max(largest, integrator.getStepDensity())
    except openmm.OpenMMException:
        return Run(steps, math.inf, step, largest)
    if integrator.getNumForceEvaluations() != steps + 1:
        raise RuntimeError("a step has cost more than one evaluation of the forces")
    if remaining() > 0:
        return Run(math.ceil(steps * total_time / context.getTime()._value), math.inf, step, largest)
    return Run(steps, worst if math.isfinite(worst) else math.inf, step, largest)


def adjusted_run(start: TestSystem, total_time: float, steps: int) -> Run:
    """The run of automatic step control with about as many steps as are wanted, as far as LONGEST_STEP allows it."""
    step = total_time / steps
    longest = LONGEST_STEP * step
    too_small, too_large = 0.0, math.inf
    nearest = None
    for _ in range(MOST_TRIES):
        trial = run(start, total_time, step, True, 12 * steps)
        failed = trial.error == math.inf
        if not failed and (nearest is None or abs(trial.steps - steps) < abs(nearest.steps - steps)):
            nearest = trial
        if not failed and abs(trial.steps / steps - 1) < NEAR:
            break
        if trial.steps < steps:
            too_large = step
        else:
            too_small = step
        guess = 0.5 * step if failed and trial.steps < steps else step * trial.steps / steps
        if not too_small < guess < too_large:
            guess = math.sqrt(too_small * too_large) if too_small > 0 else 0.5 * too_large
        if step == longest == min(guess, longest):
            break
        step = min(guess, longest)
    if nearest is None:
        raise RuntimeError(f"no run of {start.name} reached its end")
    return nearest


def compare(problem: Problem, steps: int, seed: int, copy: int, part: float) -> tuple[Run, Run]:
    """Fixed and automatic steps from one start, for a part or a multiple of the problem's time and steps."""
    start = copy_of(start_of(problem, seed), copy)
    own = adjusted_run(start, part * problem.total_time, round(part * steps))
    return run(start, part * problem.total_time, part * problem.total_time / own.steps, False, 2 * own.steps), own


def summary(problem: Problem, steps: int, pairs: Sequence[tuple[Run, Run]]) -> Result:
    """Geometric means over the starts."""
    survivors = [(fixed, own) for fixed, own in pairs if math.isfinite(fixed.error)]
    gains = [fixed.error / own.error for fixed, own in survivors]

    def mean(values: list[float]) -> float:
        return math.exp(sum(map(math.log, values)) / len(values)) if values else math.nan

    return Result(
        system=problem.name,
        wanted_steps=steps,
        steps=mean([own.steps for _, own in pairs]),
        starts=len(pairs),
        gain=mean(gains),
        smallest_gain=min(gains, default=math.nan),
        largest_gain=max(gains, default=math.nan),
        gain_error=float(np.std(np.log(gains), ddof=1)) / math.sqrt(len(gains)) if len(gains) > 1 else math.nan,
        fixed_error=mean([fixed.error for fixed, _ in survivors]),
        automatic_error=mean([own.error for _, own in survivors]),
        largest_density=max(own.largest_density for _, own in pairs),
        fixed_failures=len(pairs) - len(survivors),
    )


def table(results: Sequence[Result]) -> list[str]:
    """One line for each system and number of steps, in Markdown."""

    def number(x: float) -> str:
        return f"{x:,.0f}" if x >= 99.5 else f"{x:.3g}"

    lines = [
        "| system | steps | gain | standard error | from start to start | error, fixed | error, automatic | largest "
        "density |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        lines.append(
            f"| {r.system} | {round(r.steps):,} | {number(r.gain)} | {r.gain_error:.0%} | "
            f"{number(r.smallest_gain)} to {number(r.largest_gain)} | {r.fixed_error:.2g} | {r.automatic_error:.2g} | "
            f"{number(r.largest_density)} |"
        )
    return lines


def faults(results: Sequence[Result]) -> list[str]:
    """Where the gain is less than the project claims."""
    return [
        f"{r.system}, {round(r.steps):,} steps: gain {r.gain:.3g}, claimed {PROBLEMS[r.system].least_gain:g}"
        for r in results
        if not r.gain >= PROBLEMS[r.system].least_gain
    ]


def draw_gains(results: Sequence[Result]) -> Figure:
    """The gain on every system."""
    names = list(dict.fromkeys(r.system for r in results))
    figure = Figure(figsize=(8.0, 0.6 + 0.27 * len(names)), dpi=110, layout="constrained")
    axes = figure.add_subplot(xscale="log", xlabel="largest energy error of fixed steps / of automatic ones")
    for number, colour in enumerate(("#0072B2", "#E69F00")):
        some = [[r for r in results if r.system == name][number:][:1] for name in names]
        chosen = [r for each in some for r in each]
        axes.errorbar(
            [r.gain for r in chosen],
            [names.index(r.system) + 0.16 * (2 * number - 1) for r in chosen],
            xerr=[[r.gain - r.smallest_gain for r in chosen], [r.largest_gain - r.gain for r in chosen]],
            fmt="o",
            markersize=4,
            linewidth=1,
            color=colour,
            label="more steps" if number else "fewer steps",
        )
    axes.axvline(1.0, color="0.5", linewidth=1)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.grid(axis="x", color="0.9")
    axes.legend(loc="lower right")
    return figure


def draw_monitors() -> Figure:
    """The two monitors and the density along a collision, and the dead zone."""
    start = nitrogen_collision(5.0)
    integrator = VariableStepRattleIntegrator(1.4e-3, automatic=True)
    context = openmm.Context(start.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(start.positions)
    context.setVelocities(start.velocities)
    times, values, densities = [], [], []
    while context.getTime()._value < 0.4:
        integrator.step(1)
        times.append(context.getTime()._value)
        densities.append(integrator.getStepDensity())
        values.append([integrator.getMonitorValue(k) for k in range(2)])
    references = [integrator.getReferenceMonitorValue(k) for k in range(2)]
    on_step, half_step = ((np.array(values) / references) ** (2 / 3, 0.8)).T
    figure = Figure(figsize=(10.0, 3.6), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    left.semilogy(times, on_step, color="#D55E00", linewidth=1.2, label="$u_A$: forces, and forces times speed squared")
    left.semilogy(times, half_step, color="#0072B2", linewidth=1.2, label="$u_B$: change of the forces along the step")
    left.semilogy(times, densities, "k.", markersize=2.5, label=r"$\rho$ = nominal step / step")
    left.axhspan(left.get_ylim()[0], 2.5, color="0.85", zorder=0)
    left.axvline(times[integrator.getCalibrationSteps() - 1], color="0.6", linewidth=0.8, linestyle="--")
    left.set(xlabel="time (ps)", title="two N2 that collide at 5 km/s")
    left.set_ylim(top=80)  # room for the legend
    left.legend(fontsize=8, loc="upper left")
    u = np.geomspace(0.1, 10, 300)
    right.loglog(u, (1 + np.maximum(0, (u / 2.5) ** 4 - 0.8**4) ** 4) ** (1 / 16), color="k")
    right.axvspan(0.1, 2.5, color="0.85", zorder=0)
    right.set(xlabel="$u$", ylabel=r"$\varphi(u)$", title="the dead zone", ylim=(0.5, 6), xlim=(0.1, 10))
    right.set_yticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
    right.set_xticks([0.1, 1, 2, 10], ["0.1", "1", "2", "10"])
    right.minorticks_off()
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n")[0], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--systems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS), metavar="NAME")
    parser.add_argument("--starts", type=int, default=8, help="starts of each system (default: 8)")
    parser.add_argument("--copies", type=int, default=1, help="slightly different runs from each start (default: 1)")
    parser.add_argument("--longer", type=float, default=1.0, help="a factor of the time and the steps (default: 1)")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes (default: 1)")
    parser.add_argument("--quick", action="store_true", help="one start and a twentieth of the time; proves nothing")
    parser.add_argument("--output", type=Path, default=Path("out/automatic"), metavar="FOLDER")
    parser.add_argument("--page", action="store_true", help="put tables and figures into docs/automatic_benchmark.md")
    options = parser.parse_args(arguments)
    is_longer = options.longer != 1.0
    if options.page and (options.quick or not is_longer and options.systems != list(PROBLEMS)):
        parser.error("the page shows a run of everything, and one of any systems with --longer")
    options.output.mkdir(parents=True, exist_ok=True)
    seeds = range(1, 2 if options.quick else options.starts + 1)
    part = 0.05 if options.quick else options.longer
    began = time.perf_counter()
    tasks = [(PROBLEMS[name], steps) for name in options.systems for steps in PROBLEMS[name].steps]
    results = []
    with ProcessPoolExecutor(options.jobs) as pool:
        futures = [
            [pool.submit(compare, *task, seed, copy, part) for seed in seeds for copy in range(options.copies)]
            for task in tasks
        ]
        for (problem, steps), some in zip(tasks, futures, strict=True):
            results.append(summary(problem, steps, [future.result() for future in some]))
            print(json.dumps(asdict(results[-1])), flush=True)
    (options.output / "automatic.jsonl").write_text("".join(json.dumps(asdict(r)) + "\n" for r in results))
    draw_gains(results).savefig(options.output / "gains.png")
    draw_monitors().savefig(options.output / "monitors.png")
    print("\n".join(table(results)))
    if options.page:
        for name in ("gains", "monitors") if not is_longer else ():
            shutil.copy(options.output / f"{name}.png", pages.DOCS / "images" / f"automatic-{name}.png")
        block = "longer" if is_longer else "gains"
        pages.write(pages.DOCS / "automatic_benchmark.md", block, [pages.provenance(), "", *table(results)])
    print(f"{len(results) * len(seeds) * options.copies} comparisons in {time.perf_counter() - began:.0f} s")
    wrong = faults(results)
    for fault in wrong:
        print(f"FAULT: {fault}")
    return 1 if wrong and not options.quick else 0


if __name__ == "__main__":
    sys.exit(main())
