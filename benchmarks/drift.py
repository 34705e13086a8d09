# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Long runs of rigid water: does the energy drift, and do the constraints hold?

    python benchmarks/drift.py [--quick] [--systems NAME ...] [--integrators NAME ...] [--starts N] [--time PS]

Two systems, 8 waters in a soft trap (10^6 steps from each of 8 starts, platform Reference) and a periodic box of 216
waters with PME (10^5 steps, platform CPU), are each run by five integrators, with as many evaluations of the forces for
each: VariableStepRattleIntegrator with the monitor ConstraintMultipliers (the paper's U2) and with
ConstraintAndAppliedForce, OpenMM's VerletIntegrator with the mean step of the former (1 fs if that is not run),
VariableStepRattleIntegrator with automatic step control and the same nominal step, and VariableVerletIntegrator with
the error tolerance that gives that mean step.

The drift is the slope of a straight line through the total energy. An energy can also go up and down at random, ever
farther from its start, and then a straight line has a slope without there being a drift: that is the walk, the root
mean square by which the energy has gone away after 1 ns, beyond its fluctuations. The error of the drift accounts for
it; with several starts it is the standard error of their mean.

Prints a table and one line of JSON for each system and integrator, and writes drift.png, and drift.csv with energies.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from matplotlib.figure import Figure
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import constraint_error, project_onto_constraints, rigid_waters

TEMPERATURE = 300.0  # K
NOMINAL_STEP = 0.001  # ps
TOLERANCE = 1e-8  # of the constraints, relative, for every integrator
BLOCKS = 20
BOLTZMANN = 0.00831446261815324  # kJ/mol/K
COLOURS = {
    "VRATTLE U2": "#D55E00",
    "VRATTLE force": "#009E73",
    "VRATTLE automatic": "#000000",
    "Verlet": "#E69F00",
    "VariableVerlet": "#56B4E9",
}


Start = tuple[np.ndarray, np.ndarray]  # positions in nm and velocities in nm/ps
Series = list[tuple[np.ndarray, np.ndarray]]  # times in ps and energies in kJ/mol, of each start


@dataclass(frozen=True)
class Problem:
    """A system, where to start, and how long to run it."""

    name: str
    description: str
    system: openmm.System
    starts: list[Start]
    platform: str
    properties: dict[str, str]
    steps: int
    """from each start"""
    sample_every: int

    def context(self, integrator: openmm.Integrator, start: Start) -> openmm.Context:
        platform = openmm.Platform.getPlatformByName(self.platform)
        context = openmm.Context(self.system, integrator, platform, self.properties)
        context.setPositions(start[0])
        context.setVelocities(start[1])
        return context

    def degrees_of_freedom(self) -> int:
        moving = sum(self.system.getParticleMass(i)._value > 0 for i in range(self.system.getNumParticles()))
        return 3 * moving - self.system.getNumConstraints()


@dataclass(frozen=True)
class Run:
    """What one integrator did, from all starts. Energies in kJ/mol, times in ps."""

    problem: str
    integrator: str
    platform: str
    starts: int
    steps: int
    """from each start"""
    force_evaluations: int
    """from all starts"""
    mean_step: float
    smallest_step: float
    largest_step: float
    total_time: float
    """of the run from each start, in the mean"""
    drift: float
    """kJ/mol/ns, the mean over the starts"""
    drift_error: float
    """its standard error"""
    drift_per_freedom: float
    """in units of kT per degree of freedom and ns"""
    walk: float
    """kJ/mol over the root of 1 ns"""
    fluctuation: float
    """standard deviation of the energy within short pieces of the run"""
    constraint_error: float
    """the largest relative error of a constrained distance in any sample"""
    rescues: int
    wall_time: float
    """s"""


def small_problem(quick: bool, starts: int | None = None) -> Problem:
    """Eight waters; a soft wall beyond 0.7 nm brings back what evaporates."""
    starts = starts or (2 if quick else 8)
    examples = [rigid_waters(8, TEMPERATURE, seed) for seed in range(1, starts + 1)]
    system = examples[0].system
    wall = openmm.CustomExternalForce("100*max(0,sqrt(x*x+y*y+z*z)-0.7)^2")
    for i in range(0, system.getNumParticles(), 3):
        wall.addParticle(i, [])
    system.addForce(wall)
    return Problem(
        name="8 waters",
        description="8 rigid TIP3P waters",
        system=system,
        starts=[(example.positions, example.velocities) for example in examples],
        platform="Reference",
        properties={},
        steps=10_000 if quick else 1_000_000,
        sample_every=10 if quick else 100,
    )


def box_problem(quick: bool) -> Problem:
    """A periodic box of 216 waters, brought to 1 bar and 300 K by OpenMM's own integrators."""
    force_field = app.ForceField("tip3p.xml")
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(force_field, model="tip3p", numAdded=216)

    def create_system() -> openmm.System:
        system = force_field.createSystem(
            modeller.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.8, removeCMMotion=False
        )
        for force in system.getForces():
            if isinstance(force, openmm.NonbondedForce):
                # So that it is not the cutoff that spoils the energy.
                force.setUseSwitchingFunction(True)
                force.setSwitchingDistance(0.7)
                force.setEwaldErrorTolerance(1e-4)
        return system

    system = create_system()
    barostat = openmm.MonteCarloBarostat(1.0, TEMPERATURE, 10)
    barostat.setRandomNumberSeed(3)
    system.addForce(barostat)
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, 5.0, 0.002)
    integrator.setRandomNumberSeed(4)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(modeller.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(TEMPERATURE, 5)
    integrator.step(200 if quick else 15_000)
    state = context.getState(positions=True, velocities=True)
    system = create_system()
    system.setDefaultPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    start = project_onto_constraints(
        system, state.getPositions(asNumpy=True)._value, state.getVelocities(asNumpy=True)._value
    )
    return Problem(
        name="216 waters",
        description="216 rigid TIP3P waters, PME",
        system=system,
        starts=[start],
        platform="CPU",
        properties={"Threads": "2"},
        steps=200 if quick else 100_000,
        sample_every=5 if quick else 50,
    )


def make_vrattle(kind: int) -> VariableStepRattleIntegrator:
    integrator = VariableStepRattleIntegrator(NOMINAL_STEP)
    integrator.clearMonitors()
    integrator.addMonitor(kind)
    return integrator


def tuned_variable_verlet(problem: Problem, mean_step: float) -> float:
    """The error tolerance for which trial runs have the mean step that is asked for: the step goes with its root."""
    tolerance = 1e-4
    trial_steps = max(problem.steps // 100, 1000 if problem.platform == "Reference" else 50)
    for i in range(4):
        integrator = openmm.VariableVerletIntegrator(tolerance)
        integrator.setConstraintTolerance(TOLERANCE)
        context = problem.context(integrator, problem.starts[i % len(problem.starts)])
        integrator.step(trial_steps // 10)  # its first steps are far from the mean
        start = context.getTime()._value
        integrator.step(trial_steps)
        tolerance *= (mean_step * trial_steps / (context.getTime()._value - start)) ** 2
    return tolerance


def fit_drift(times: np.ndarray, energies: np.ndarray) -> tuple[float, float, float]:
    """The slope of the energy with time, its standard error, and the walk per root of time, from means of blocks."""
    count = len(times) // BLOCKS
    x = times[: BLOCKS * count].reshape(BLOCKS, count).mean(axis=1)
    y = energies[: BLOCKS * count].reshape(BLOCKS, count).mean(axis=1)
    block = (x[-1] - x[0]) / (BLOCKS - 1)
    x = x - x.mean()
    slope = float(x @ y / (x @ x))
    rest = y - y.mean() - slope * x
    scatter = float(rest @ rest) / (BLOCKS - 2) / float(x @ x)
    # Fluctuations differ as much between far blocks as between neighbours, a walk in proportion to the distance.
    near, far = (float(np.mean((rest[lag:] - rest[:-lag]) ** 2)) for lag in (1, 5))
    walk = max(0.0, far - near) / 4 / block
    # The slope through a random walk has the variance 6/5 of the walk over the whole time.
    return slope, math.sqrt(scatter + 1.2 * walk / (BLOCKS * block)), math.sqrt(walk)


def simulate(
    problem: Problem, name: str, make: Callable[[], Any], progress: Callable[[str], None]
) -> tuple[Run, Series]:
    """Run one integrator from all starts."""
    samples = problem.steps // problem.sample_every
    series: Series = []
    fits: list[tuple[float, float, float]] = []
    sizes = np.empty(samples)
    smallest, largest, worst, evaluations, rescues = math.inf, 0.0, 0.0, 0, 0
    started = time.monotonic()
    for number, start in enumerate(problem.starts):
        integrator = make()
        context = problem.context(integrator, start)
        times, energies = np.empty(samples), np.empty(samples)
        for i in range(samples):
            integrator.step(problem.sample_every)
            state = context.getState(positions=True, energy=True)
            times[i] = state.getTime()._value
            energies[i] = state.getKineticEnergy()._value + state.getPotentialEnergy()._value
            sizes[i] = integrator.getStepSize()._value
            worst = max(worst, constraint_error(problem.system, state.getPositions(asNumpy=True)._value))
        progress(f"{problem.name}, {name}: start {number + 1} of {len(problem.starts)} done")
        series.append((times, energies))
        fits.append(fit_drift(times, energies))
        smallest, largest = min(smallest, float(sizes.min())), max(largest, float(sizes.max()))
        if isinstance(integrator, VariableStepRattleIntegrator):
            evaluations += integrator.getNumForceEvaluations()
            rescues += integrator.getNumRescues()
        else:
            evaluations += samples * problem.sample_every  # OpenMM's integrators do not count: once a step
        del context
    drifts = np.array([fit[0] for fit in fits])
    count = len(fits)
    drift_error = fits[0][1] if count == 1 else float(np.std(drifts, ddof=1)) / math.sqrt(count)
    pieces = [float(np.std(energies[i : i + 50])) for _, energies in series for i in range(0, samples - 49, 50)]
    total_time = float(np.mean([times[-1] for times, _ in series]))
    run = Run(
        problem=problem.name,
        integrator=name,
        platform=problem.platform,
        starts=count,
        steps=samples * problem.sample_every,
        force_evaluations=evaluations,
        mean_step=total_time / (samples * problem.sample_every),
        smallest_step=smallest,
        largest_step=largest,
        total_time=total_time,
        drift=1000 * float(drifts.mean()),
        drift_error=1000 * drift_error,
        drift_per_freedom=1000 * float(drifts.mean()) / (BOLTZMANN * TEMPERATURE * problem.degrees_of_freedom()),
        walk=math.sqrt(1000 * float(np.mean([fit[2] ** 2 for fit in fits]))),
        fluctuation=float(np.mean(pieces)) if pieces else 0.0,
        constraint_error=worst,
        rescues=rescues,
        wall_time=time.monotonic() - started,
    )
    return run, series


def run_problem(
    problem: Problem, names: Sequence[str], progress: Callable[[str], None]
) -> tuple[list[Run], dict[str, Series]]:
    """The integrators of these names on one problem."""
    runs: list[Run] = []
    series: dict[str, Series] = {}

    def add(name: str, make: Callable[[], Any]) -> None:
        if name not in names:
            return
        run, its_series = simulate(problem, name, make, progress)
        runs.append(run)
        series[name] = its_series

    def make_openmm(kind: Callable[[float], Any], argument: float) -> Any:
        integrator = kind(argument)
        integrator.setConstraintTolerance(TOLERANCE)
        return integrator

    add("VRATTLE U2", lambda: make_vrattle(VariableStepRattleIntegrator.ConstraintMultipliers))
    add("VRATTLE force", lambda: make_vrattle(VariableStepRattleIntegrator.ConstraintAndAppliedForce))
    mean_step = runs[0].mean_step if "VRATTLE U2" in names else NOMINAL_STEP
    add("VRATTLE automatic", lambda: VariableStepRattleIntegrator(mean_step, automatic=True))
    add("Verlet", lambda: make_openmm(openmm.VerletIntegrator, mean_step))
    if "VariableVerlet" not in names:
        return runs, series
    tolerance = tuned_variable_verlet(problem, mean_step)
    add("VariableVerlet", lambda: make_openmm(openmm.VariableVerletIntegrator, tolerance))
    return runs, series


def verdict(runs: Sequence[Run]) -> list[str]:
    """What is wrong with our runs of one problem; nothing if all is well."""
    verlet = next(run for run in runs if run.integrator == "Verlet")
    faults = []
    for run in runs:
        if not run.integrator.startswith("VRATTLE"):
            continue
        allowed = abs(verlet.drift) + 3 * math.hypot(run.drift_error, verlet.drift_error)
        if not abs(run.drift) <= allowed:
            faults.append(
                f"{run.problem}, {run.integrator}: drift {run.drift:.3g} kJ/mol/ns, more than the {allowed:.3g} of "
                "VerletIntegrator and three standard errors"
            )
        # Rounding of coordinates of 1 nm: 1e-16, against a bond of 0.1 nm. (OpenMM's SETTLE keeps distances that were
        # rounded to single precision, so 3e-8 is what VerletIntegrator shows at any tolerance.)
        if not run.constraint_error <= TOLERANCE + 1e-14:
            faults.append(f"{run.problem}, {run.integrator}: constraint error {run.constraint_error:.2g}")
    return faults


def table(runs: Sequence[Run]) -> list[str]:
    header = (
        f"{'system':<10} {'integrator':<17} {'steps':>11} {'mean step':>9} {'drift':>17} {'per freedom':>11} "
        f"{'walk':>9} {'fluctuation':>11} {'constraints':>11} {'wall':>5}"
    )
    units = (
        f"{'':<10} {'':<17} {'':>11} {'fs':>9} {'kJ/mol/ns':>17} {'kT/ns':>11} {'kJ/mol/√ns':>9} {'kJ/mol':>10} "
        f"{'worst':>11} {'s':>5}"
    )
    lines = [header, units, "-" * len(header)]
    for run in runs:
        steps = f"{run.starts} x {run.steps}" if run.starts > 1 else str(run.steps)
        lines.append(
            f"{run.problem:<10} {run.integrator:<17} {steps:>11} {1000 * run.mean_step:>9.4f} "
            f"{run.drift:>8.3g} ± {run.drift_error:<6.2g} {run.drift_per_freedom:>11.1e} {run.walk:>9.2g} "
            f"{run.fluctuation:>11.3g} {run.constraint_error:>11.1e} {run.wall_time:>5.0f}"
        )
    return lines


def draw(problems: Sequence[Problem], all_series: Sequence[dict[str, Series]]) -> Figure:
    """The total energy against time, in means over 100 windows, one line for each start."""
    figure = Figure(figsize=(9.0, 3.6 * len(problems)), dpi=100, layout="constrained")
    panels = figure.subplots(len(problems), 1, squeeze=False)[:, 0]
    for axes, problem, series in zip(panels, problems, all_series, strict=True):
        for name in ("VariableVerlet", "VRATTLE U2", "VRATTLE force", "Verlet", "VRATTLE automatic"):
            for number, (times, energies) in enumerate(series.get(name, [])):
                size = max(1, len(times) // 100)
                count = len(times) // size
                x = times[: count * size].reshape(count, size).mean(axis=1)
                y = energies[: count * size].reshape(count, size).mean(axis=1) - energies[:size].mean()
                axes.plot(x, y, color=COLOURS[name], linewidth=1.1, label=None if number else name)
        starts = f" from each of {len(problem.starts)} starts" if len(problem.starts) > 1 else ""
        axes.set_title(
            f"{problem.description}: {problem.steps:,} steps{starts}, platform {problem.platform}", fontsize=11
        )
        axes.set_ylabel("total energy - start (kJ/mol)")
        axes.grid(True, color="#dddddd", linewidth=0.6)
        axes.set_xlim(left=0)
        axes.legend(loc="best", fontsize=9, ncols=2)
    panels[-1].set_xlabel("time (ps)")
    return figure


def write_csv(path: Path, problems: Sequence[Problem], all_series: Sequence[dict[str, Series]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["system", "integrator", "start", "time (ps)", "energy (kJ/mol)"])
        for problem, series in zip(problems, all_series, strict=True):
            for name, runs in series.items():
                for number, (times, energies) in enumerate(runs):
                    for t, energy in zip(times, energies, strict=True):
                        writer.writerow([problem.name, name, number, f"{t:.6f}", f"{energy:.6f}"])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Energy drift of long runs of rigid water.")
    parser.add_argument("--quick", action="store_true", help="a hundredth of the steps: seconds, and no verdict")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder of drift.png and drift.csv")
    systems = ("8-waters", "216-waters")
    parser.add_argument("--systems", nargs="+", choices=systems, default=systems, metavar="NAME")
    parser.add_argument(
        "--integrators",
        nargs="+",
        choices=COLOURS,
        default=list(COLOURS),
        metavar="NAME",
        help="VerletIntegrator, the measure of the others, is always run: " + ", ".join(COLOURS),
    )
    parser.add_argument("--starts", type=int, help="of the 8 waters")
    parser.add_argument("--time", type=float, help="from each start, in ps, at the nominal step of 1 fs")
    options = parser.parse_args(arguments)
    names = {*options.integrators, "Verlet"}
    options.output.mkdir(parents=True, exist_ok=True)

    def progress(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    problems = [
        small_problem(options.quick, options.starts) if name == "8-waters" else box_problem(options.quick)
        for name in options.systems
    ]
    if options.time:
        problems = [replace(problem, steps=round(options.time / NOMINAL_STEP)) for problem in problems]
    runs: list[Run] = []
    all_series = []
    faults: list[str] = []
    for problem in problems:
        its_runs, series = run_problem(problem, names, progress)
        runs += its_runs
        all_series.append(series)
        faults += verdict(its_runs)
    print("\n".join(table(runs)))
    for run in runs:
        print(json.dumps(asdict(run)))
    for fault in faults:
        print(f"FAULT: {fault}")
    write_csv(options.output / "drift.csv", problems, all_series)
    draw(problems, all_series).savefig(options.output / "drift.png")
    return 1 if faults and not options.quick else 0


if __name__ == "__main__":
    sys.exit(main())
