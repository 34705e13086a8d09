# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Section 5 of Barth, Leimkuhler and Reich (1999): an elastic rod that swings against a wall.

The rod bends and twists but neither stretches nor shears; its sections are rigid, held and joined by 54 constraints, of
which 27 are expressions given to the integrator. The difficulty is no constraint but the force of the wall, so the step
follows the distance from the wall: the paper's U3, the largest D^-a of all distances D. Compared are RATTLE with fixed
steps and VRATTLE with U3, with its smooth form, and with monitors that do not know the distance: the norm of the vector
field, U1, U2 and the force of Gauss's principle; each with as many force evaluations as the RATTLE that it is held
against.

    python examples/elastic_rod.py            five figures, a table and the paper's claims
    python examples/elastic_rod.py --quick    the same with 350 and 1,000 steps only
"""

from __future__ import annotations

import argparse
import bisect
import csv
import functools
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import openmm
from matplotlib.figure import Figure
from openmmvrattle.compare.comparison import Series, make_integrator, two_digits
from openmmvrattle.platforms import add_platform_arguments, make_context, platform_from
from openmmvrattle.testsystems import MonitorSettings, StepControl, TestSystem, elastic_rod
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

TIME = 1.0
"""ps, as in the paper."""
WALL = 0.65
"""nm; the distance of the walls from x = 0."""
EXPONENT = 3.0
"""a in U3 = max D^-a, as in the paper's figures."""
FIRST_STEPS = (0.02, 0.04)
"""ps; the first steps of the paper's figure 5.4."""
STEPS = (125, 350, 1000, 4000)
"""About how many steps the runs of figure 5.5 take."""
QUICK_STEPS = STEPS[1:3]
MOST_STEPS = 20_000
LATER_START = 0.06
"""ps; a start from which the end of the rod is on its way to the wall already."""

platform = "Reference"
"""On which everything runs; ``--platform`` names another."""

Progress = Callable[[str], None]
"""Called with what is about to be run."""


# ------------------------------------------------------------------------------------------------------ what is run


@dataclass(frozen=True)
class Method:
    """A way of choosing the steps, without its first step, and its name in tables and figures."""

    name: str
    monitor: str
    """The kind of the monitor; none for fixed steps."""
    power: float = 1.0
    form: str = "maximum"
    """How the force group of ``ForceGroupEnergy`` states the nearness of the wall, see `elastic_rod`."""
    is_bounded: bool = False
    """Whether the steps have bounds, of 1/50 and 2 of the first; the paper has none."""
    has_simple_start: bool = False
    """Whether the density starts as the paper's simple start has it, and not as the integrator would start it."""

    def control(self, first_step: float) -> StepControl:
        """The settings of the integrator."""
        monitors = (MonitorSettings(self.monitor, power=self.power),) if self.monitor else ()
        bounds = (1 / 50, 2.0) if self.is_bounded else (0.0, 0.0)
        return StepControl(monitors, first_step, *bounds)


def _nearness(exponent: float) -> Method:
    return Method(f"U3, a = {exponent:g}", "ForceGroupEnergy", exponent)


RATTLE = Method("RATTLE", "")
U3 = _nearness(EXPONENT)
U3_SIMPLE = replace(U3, name="U3, a = 3, simple start", has_simple_start=True)
# The force group holds the sum of D^-24 instead of the largest 1/D.
SMOOTH = Method("U3, a = 3, smooth", "ForceGroupEnergy", EXPONENT / 24, "smooth")
VECTOR_FIELD = Method("vector field", "ArcLength")
U1 = Method("U1", "VectorField")
# Without a largest step they grow it where the constraint forces nearly vanish, and do not come to an end.
U2 = Method("U2", "ConstraintMultipliers", is_bounded=True)
GAUSS = Method("Gauss", "ConstraintForce", is_bounded=True)
METHODS = (_nearness(1.0), _nearness(2.0), U3, U3_SIMPLE, _nearness(6.0), SMOOTH, VECTOR_FIELD, U1, U2, GAUSS)


@dataclass(frozen=True)
class Run:
    """What was measured along one run, after every step."""

    first_step: float
    """ps"""
    force_evaluations: int
    solver_iterations: int
    rescues: int
    initial_energy: float
    """kJ/mol"""
    series: Series = field(repr=False)
    densities: np.ndarray = field(repr=False)
    """rho of each step, in the unit of the monitor; the number of steps."""
    nearness: np.ndarray = field(repr=False)
    """The largest 1/D of each sample, in 1/nm."""
    positions: np.ndarray = field(repr=False)
    """nm: samples x sections x 3 points x (x, y, z)."""
    failure: str | None = None
    """Why the run did not reach its end."""

    @property
    def steps(self) -> int:
        """The number of steps."""
        return len(self.series.times) - 1

    @property
    def largest_error(self) -> float:
        """The largest energy error in kJ/mol."""
        return float(np.max(np.abs(self.series.energy_errors)))

    @property
    def rms_error(self) -> float:
        """The root of the time average of the squared energy error, in kJ/mol."""
        times, errors = self.series.times, self.series.energy_errors
        return float(np.sqrt(np.sum(np.diff(times) * errors[1:] ** 2) / TIME))


class OpenContext:
    """A Context of a rod with a step control, in which one run follows the other, each as if it were new.

    The runs here are many and short, and a GPU takes longer to compile for a Context than for the steps of a run.
    """

    kept: ClassVar[dict[Any, OpenContext]] = {}

    def __init__(self, rod: TestSystem, control: StepControl) -> None:
        self.rod, self.integrator = rod, make_integrator(control)
        rod.prepare(self.integrator)
        self.context = make_context(rod.system, self.integrator, platform)
        self.context.setPositions(rod.positions)
        self.fresh = self.context.createCheckpoint()

    @classmethod
    def of(cls, rod: TestSystem, control: StepControl) -> OpenContext:
        """One for this control, whatever its nominal step, in the state in which a run begins."""
        key = (id(rod.system), replace(control, nominal_step_size=1.0), platform)
        if key not in cls.kept:
            cls.kept[key] = cls(rod, control)
        here = cls.kept[key]
        here.context.loadCheckpoint(here.fresh)
        nominal = control.nominal_step_size
        here.integrator.setStepSize(nominal)
        here.integrator.setMinimumStepSize(control.smallest_step_ratio * nominal)
        here.integrator.setMaximumStepSize(control.largest_step_ratio * nominal)
        return here


@functools.cache
def rod_with(form: str) -> TestSystem:
    """The rod of the paper, whose force group states the nearness of the wall in this form, see `elastic_rod`."""
    return elastic_rod(monitor=form)


class Recorder:
    """A rod in a Context, and what is seen of it after each step."""

    def __init__(self, rod: TestSystem, control: StepControl, start: float = 0.0) -> None:
        here = OpenContext.of(rod, control)
        self.rod, self.integrator, self.context = rod, here.integrator, here.context
        self.counts = self.count()
        self.context.setPositions(rod.positions)
        self.context.setVelocities(rod.velocities)
        self.times, self.energies, self.sizes = [start], [], [math.nan]
        self.densities: list[float] = []
        self.positions: list[np.ndarray] = []
        self.look()

    def count(self) -> np.ndarray:
        """Force evaluations, solver iterations and rescues in this Context."""
        i = self.integrator
        return np.array([i.getNumForceEvaluations(), i.getNumSolverIterations(), i.getNumRescues()])

    def look(self) -> None:
        """Record energy and positions."""
        state = self.context.getState(energy=True, positions=True, groups=self.rod.force_groups)
        self.energies.append(state.getKineticEnergy()._value + state.getPotentialEnergy()._value)
        self.positions.append(state.getPositions(asNumpy=True)._value.reshape(-1, 3, 3))

    def step(self, density: float | None = None) -> None:
        """Take one step; the density is that of the integrator if it is not given."""
        self.integrator.step(1)
        size = self.integrator.getStepSize()._value
        self.times.append(self.times[-1] + size)
        self.sizes.append(size)
        self.densities.append(self.integrator.getStepDensity() if density is None else density)
        self.look()

    def finish(self, first_step: float, scale: float = 1.0, failure: str | None = None) -> Run:
        """The run so far; the densities are multiplied by scale."""
        positions = np.array(self.positions)
        force_evaluations, solver_iterations, rescues = (int(each) for each in self.count() - self.counts)
        return Run(
            first_step=first_step,
            force_evaluations=force_evaluations,
            solver_iterations=solver_iterations,
            rescues=rescues,
            initial_energy=self.energies[0],
            series=Series(np.array(self.times), np.array(self.energies) - self.energies[0], np.array(self.sizes)),
            densities=np.array(self.densities) * scale,
            nearness=nearness(positions),
            positions=positions,
            failure=failure,
        )


def nearness(positions: np.ndarray) -> np.ndarray:
    """The largest 1/D of the moving sections, of each sample."""
    centres = positions[..., 1:, :, 0].mean(axis=-1)
    return 1.0 / (WALL - np.max(np.abs(centres), axis=-1))


def run_rod(
    method: Method,
    first_step: float,
    steps: int | None = None,
    rod: TestSystem | None = None,
    start: float = 0.0,
    most: int = MOST_STEPS,
) -> Run:
    """Run the rod to the end of the time and look at it after every step.

    Args:
        method: how the steps are chosen.
        first_step: ps; the nominal step.
        steps: end after this number of steps instead.
        most: a run that needs more steps than that has failed.
        rod: the rod and its state at the start; by default the one of the paper.
        start: the time of that state in ps.
    """
    rod = rod or rod_with(method.form)
    if method.has_simple_start:
        return run_with_density(first_step, difficulty(rod), rod, start)
    recorder = Recorder(rod, method.control(first_step), start)
    end = TIME * (1.0 - 1e-9)  # a sum of many steps is rounded
    failure = None
    try:
        while recorder.times[-1] < end if steps is None else len(recorder.densities) < steps:
            if len(recorder.densities) == most:
                raise openmm.OpenMMException(f"more than {most:,} steps")
            recorder.step()
    except openmm.OpenMMException as error:
        failure = str(error)
    scale = 1.0
    if method.monitor:
        scale = recorder.integrator.getReferenceMonitorValue() ** method.power
    return recorder.finish(first_step, scale, failure)


def difficulty(rod: TestSystem) -> float:
    """U3 in the state of the rod."""
    return float(nearness(rod.positions.reshape(-1, 3, 3))) ** EXPONENT


def run_with_density(first_step: float, before: float, rod: TestSystem, start: float) -> Run:
    """VRATTLE (3.15) with U3, but with a density before the start, rho[-1/2], of our own choice.

    With a monitor of the positions alone the density is known before each step, and the step is one of RATTLE of that
    size. So the recursion is done here, and the integrator, without a monitor, is told each step.

    Args:
        first_step: ps; h divided by U3 at the start.
        before: rho[-1/2].
        rod: the rod and its state at the start.
        start: the time of that state in ps.
    """
    recorder = Recorder(rod, RATTLE.control(first_step), start)
    constant = first_step * difficulty(rod)
    density, failure = before, None
    try:
        while recorder.times[-1] < TIME * (1.0 - 1e-9):
            density = 2.0 * float(nearness(recorder.positions[-1])) ** EXPONENT - density
            recorder.integrator.setStepSize(constant / density)
            recorder.step(density)
    except openmm.OpenMMException as error:
        failure = str(error)
    return recorder.finish(first_step, 1.0, failure)


def density_one_step_back(first_step: float, rod: TestSystem) -> float:
    """The paper's value of rho[-1/2]: the mean of U3 at the start and one step of RATTLE back in time."""
    backwards = replace(rod, velocities=-rod.velocities)
    recorder = Recorder(backwards, RATTLE.control(first_step))
    recorder.step()
    return float(np.mean(nearness(np.array(recorder.positions)) ** EXPONENT))


def rod_on_its_way() -> TestSystem:
    """The rod at the later start, by small fixed steps."""
    rod = rod_with("maximum")
    recorder = Recorder(rod, RATTLE.control(2e-4))
    recorder.integrator.stepTo(LATER_START)
    state = recorder.context.getState(positions=True, velocities=True)
    positions, velocities = state.getPositions(asNumpy=True)._value, state.getVelocities(asNumpy=True)._value
    return replace(rod, positions=positions, velocities=velocities)


@dataclass(frozen=True)
class Trial:
    """A method, and RATTLE with fixed steps over the same time with the same number of force evaluations."""

    method: Method
    variable: Run
    fixed: Run

    @property
    def gain(self) -> float:
        """How many times smaller the largest energy error is than that of fixed steps; NaN after a failure."""
        if self.variable.failure is not None or self.fixed.failure is not None:
            return math.nan
        return self.fixed.largest_error / self.variable.largest_error


@dataclass(frozen=True)
class Starts:
    """The same motion with three choices of the density before the start."""

    start: float
    """ps"""
    simple: Run
    """rho[-1/2] = U(q0)."""
    backward: Run
    """The mean of U at the start and one step before, as the paper has it."""
    ours: Run
    """The integrator's own start."""


@dataclass(frozen=True)
class Study:
    """All runs."""

    steps: tuple[int, ...]
    trials: dict[str, list[Trial]]
    """By the name of the method, in the order of the steps."""
    same_step: dict[float, tuple[Trial, Run]]
    """By the first step: U3, simple start, with its RATTLE of as many evaluations, and RATTLE with the same step."""
    starts: dict[float, Starts]
    """By the time of the start."""
    limits: dict[str, float]
    """The largest first step that RATTLE and U3 survive, in ps."""


def run_trial(variable: Run, method: Method) -> Trial:
    """A run of a method, and RATTLE with its average step, or the step that it should have had if it has failed."""
    if variable.failure is not None:
        return Trial(method, variable, variable)
    average = float(variable.series.times[-1]) / variable.steps
    return Trial(method, variable, run_rod(RATTLE, average, variable.steps))


def run_trials(method: Method, steps: Sequence[int]) -> list[Trial]:
    """A trial for about each number of steps, in rising order.

    The number of steps is nearly in inverse proportion to the first one, so that each run tells that of the next. Where
    it is not, the best of four tries is taken.
    """
    product = 2.0 * TIME
    trials: list[Trial] = []
    for number in reversed(steps):
        tries: list[Run] = []
        while len(tries) < 4 and not (tries and abs(tries[-1].steps / number - 1) < 0.05):
            run = run_rod(method, product / number, most=5 * number)
            tries.append(run)
            reached = float(run.series.times[-1]) / TIME
            if reached > 0.5:
                product = run.first_step * run.steps / reached
            else:  # far too small steps, or far too large ones
                product *= 4.0 if run.steps == 5 * number else 0.5
        best = min(tries, key=lambda run: (run.failure is not None, abs(run.steps / number - 1)))
        trials.append(run_trial(best, method))
    return trials[::-1]


def run_starts(first_step: float, rod: TestSystem, start: float) -> Starts:
    """The three starts from one state."""
    return Starts(
        start,
        simple=run_with_density(first_step, difficulty(rod), rod, start),
        backward=run_with_density(first_step, density_one_step_back(first_step, rod), rod, start),
        ours=run_rod(U3, first_step, rod=rod, start=start),
    )


def largest_surviving_step(method: Method) -> float:
    """A first step with an error below a tenth of E, while with one 1.1 times as large it is not; by bisection."""

    def survives(power: int) -> bool:
        run = run_rod(method, 5e-3 * 1.1**power)
        return run.failure is None and run.largest_error < 0.1 * run.initial_energy

    return 5e-3 * 1.1 ** (bisect.bisect_left(range(40), True, key=lambda power: not survives(power)) - 1)


def run_study(steps: Sequence[int] = STEPS, progress: Progress | None = None) -> Study:
    """Run everything that the figures, the table and the claims need.

    Args:
        steps: about how many steps the runs of figure 5.5 take.
        progress: called before each part.
    """

    def report(what: str) -> None:
        if progress is not None:
            progress(what)

    report("U3 and RATTLE with the paper's first steps")
    same_step = {size: (run_trial(run_rod(U3_SIMPLE, size), U3_SIMPLE), run_rod(RATTLE, size)) for size in FIRST_STEPS}
    trials = {}
    for method in METHODS:
        report(f"{method.name} and RATTLE with as many force evaluations")
        trials[method.name] = run_trials(method, steps)
    report("three starts")
    first_step = FIRST_STEPS[0]
    beginning = rod_with("maximum")
    starts = {
        start: run_starts(first_step, rod, start) for start, rod in ((0.0, beginning), (LATER_START, rod_on_its_way()))
    }
    report("larger and larger first steps")
    limits = {method.name: largest_surviving_step(method) for method in (RATTLE, U3_SIMPLE)}
    return Study(tuple(steps), trials, same_step, starts, limits)


# ---------------------------------------------------------------------------------------------- the paper's claims


@dataclass(frozen=True)
class Claim:
    """Something that the paper says, the number by which it is judged here, and the verdict."""

    claim: str
    number: float
    meaning: str
    """What the number is."""
    bar: str
    """What it has to be for the claim to hold."""
    held: bool


def _claim(claim: str, number: float, meaning: str, least: float = 0.0, most: float = math.inf) -> Claim:
    """A claim that holds if its number is within the two bounds."""
    bar = f"at least {least:g}" if most == math.inf else f"{least:g} to {most:g}"
    return Claim(claim, float(number), meaning, bar, bool(least <= number <= most))


def oscillation(values: np.ndarray) -> np.ndarray:
    """The part of a sequence that changes its sign from one entry to the next, by its fourth difference."""
    result = np.zeros_like(values)
    result[2:-2] = np.convolve(values, np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 16.0, "valid")
    return np.abs(result)


def oscillation_at(values: np.ndarray, index: int) -> float:
    """The typical amplitude of the oscillation in the twelve entries around one; a single jump does not count."""
    begin = max(2, index - 6)
    return float(np.median(oscillation(values)[begin : begin + 12]))


def _peak(run: Run) -> int:
    """The step at which U3 is largest."""
    return int(np.argmax(run.nearness[1:]))


def judge_claims(study: Study) -> list[Claim]:
    """Judge what the paper's section 5 says by the runs."""
    u3, field_norm = study.trials[U3_SIMPLE.name], study.trials[VECTOR_FIELD.name]
    finest = u3[-1].fixed
    equal, same = study.same_step[FIRST_STEPS[0]]
    double = study.same_step[FIRST_STEPS[1]][0].variable
    gains = [trial.gain for trial in u3]
    later, beginning = study.starts[LATER_START], study.starts[0.0]
    simple, backward = later.simple, later.backward
    sizes = simple.series.step_sizes[1:]
    first = study.same_step[FIRST_STEPS[0]][0].variable
    middle = study.steps.index(1000)
    iterations = [run.solver_iterations / run.steps for run in (u3[middle].variable, u3[middle].fixed)]
    return [
        _claim(
            "The rod meets the wall at t = 0.17",
            finest.series.times[np.argmax(np.where(finest.series.times < 0.4, finest.nearness, 0.0))],
            "time of the nearest approach up to 0.4 ps, in ps",
            least=0.165,
            most=0.175,
        ),
        _claim(
            "The difficulty is the force of the wall, not that of the constraints",
            u3[middle].gain / study.trials[U2.name][middle].gain,
            "gain of U3 divided by the gain of U2, 1,000 steps",
            least=2,
        ),
        _claim(
            "U3 needs no additional nonlinear equations",
            iterations[0] / iterations[1],
            "solver's iterations a step, U3 divided by RATTLE, 1,000 steps",
            most=1.1,
        ),
        _claim(
            "With the same first step of 0.02 RATTLE's energy jumps at the collision and VRATTLE's does not",
            same.largest_error / first.largest_error,
            "largest error of RATTLE divided by that of U3",
            least=10,
        ),
        _claim(
            "VRATTLE is more robust",
            study.limits[U3_SIMPLE.name] / study.limits[RATTLE.name],
            "largest first step with an error below a tenth of E, U3 divided by RATTLE",
            least=2,
        ),
        _claim(
            "With a first step of 0.02 its error is smaller than RATTLE's with as many steps",
            equal.gain,
            "largest error of RATTLE divided by that of U3",
            least=2,
        ),
        _claim(
            "With a first step of 0.04 it needs only half as many steps",
            double.steps / equal.fixed.steps,
            "steps divided by those of that RATTLE",
            most=0.5,
        ),
        _claim(
            "and its error is still smaller than that of RATTLE",
            equal.fixed.largest_error / double.largest_error,
            "largest error of RATTLE divided by that of U3 with half as many steps",
            least=1,
        ),
        _claim(
            "In all cases the error is considerably smaller than with fixed steps of the same first size",
            min(run.largest_error / trial.variable.largest_error for trial, run in study.same_step.values()),
            "smallest ratio of the largest errors",
            least=10,
        ),
        _claim(
            "Step control by the norm of the vector field controls the energy error too",
            min(trial.gain for trial in field_norm),
            "smallest gain over RATTLE at any number of steps",
            least=1,
        ),
        _claim(
            "U3 gives better results than the norm of the vector field",
            min(a.gain / b.gain for a, b in zip(u3, field_norm, strict=True)),
            "smallest ratio of the gains",
            least=1,
        ),
        _claim(
            "U3 is more efficient than fixed steps at all tolerances",
            min(gains),
            "smallest gain at any number of steps",
            least=1,
        ),
        _claim(
            "The improvement is greatest at the most severe tolerance",
            gains[-1] / max(gains[:-1]),
            "gain at most steps divided by the largest of the others",
            least=1,
        ),
        _claim(
            "The oscillation of rho is ameliorated by the extrapolated start (from t = 0.06)",
            oscillation_at(simple.densities, _peak(simple)) / oscillation_at(backward.densities, _peak(backward)),
            "its amplitude where U3 is largest, simple start divided by extrapolated start",
            least=2,
        ),
        _claim(
            "The same from t = 0",
            oscillation_at(beginning.simple.densities, _peak(beginning.simple))
            / oscillation_at(beginning.backward.densities, _peak(beginning.backward)),
            "the same ratio",
            least=2,
        ),
        _claim(
            "With the simple start the oscillation of rho grows with U3",
            oscillation_at(simple.densities, _peak(simple)) / oscillation_at(simple.densities, 0),
            "amplitude where U3 is largest divided by that at the start",
            least=2,
        ),
        _claim(
            "while that of the step size remains essentially constant",
            oscillation_at(sizes, _peak(simple)) / oscillation_at(sizes, 0),
            "amplitude where U3 is largest divided by that at the start",
            least=0.5,
            most=2,
        ),
    ]


@dataclass(frozen=True)
class Finding:
    """Something that the paper does not say, measured in the same runs."""

    finding: str
    number: float


def other_findings(study: Study) -> list[Finding]:
    """What the paper does not mention, the unfavourable with the favourable."""
    middle = study.steps.index(1000)
    at_middle = {name: trials[middle] for name, trials in study.trials.items()}
    trial = at_middle[U3.name]
    coarse, fine = study.trials[U3.name][middle - 1].variable, trial.variable
    order = math.log(coarse.largest_error / fine.largest_error) / math.log(fine.steps / coarse.steps)
    ends = [abs(run.series.energy_errors[-1]) for run in (trial.variable, trial.fixed)]
    findings = [
        Finding("U3, 1,000 steps: gain in the root mean square of the error", _rms_gain(trial)),
        Finding("U3, 1,000 steps: its error at the end divided by that of RATTLE", ends[0] / ends[1]),
        Finding("U3: order of convergence, from 350 to 1,000 steps", order),
        Finding("U3, 1,000 steps: gain with the maximum", trial.gain),
        Finding("U3, 1,000 steps: gain with the smooth form", at_middle[SMOOTH.name].gain),
    ]
    for method in (U1, U2, GAUSS):
        findings.append(Finding(f"{method.name}, 1,000 steps: gain", at_middle[method.name].gain))
    for time, starts in study.starts.items():
        backward, ours = (oscillation_at(run.densities, _peak(run)) for run in (starts.backward, starts.ours))
        text = f"Oscillation of rho from t = {time:g}: extrapolated start divided by the integrator's own"
        findings.append(Finding(text, backward / ours))
    return findings


def _rms_gain(trial: Trial) -> float:
    return trial.fixed.rms_error / trial.variable.rms_error


# ----------------------------------------------------------------------------------------------- tables and files

COLUMNS = (
    "method",
    "first_step_ps",
    "force_evaluations",
    "largest_energy_error_kj_per_mol",
    "rms_energy_error_kj_per_mol",
    "final_energy_error_kj_per_mol",
    "rattle_force_evaluations",
    "rattle_largest_energy_error_kj_per_mol",
    "gain",
    "rms_gain",
    "smallest_step_taken_ps",
    "largest_step_taken_ps",
    "rescues",
    "failure",
)


def table_rows(study: Study) -> list[dict[str, Any]]:
    """One row for each method and number of steps."""
    rows = []
    for trial in (trial for trials in study.trials.values() for trial in trials):
        variable, fixed = trial.variable, trial.fixed
        values = (
            trial.method.name,
            variable.first_step,
            variable.force_evaluations,
            variable.largest_error,
            variable.rms_error,
            float(variable.series.energy_errors[-1]),
            fixed.force_evaluations,
            fixed.largest_error,
            trial.gain,
            _rms_gain(trial),
            float(np.min(variable.series.step_sizes[1:], initial=math.inf)),
            float(np.max(variable.series.step_sizes[1:], initial=0.0)),
            variable.rescues,
            variable.failure or "",
        )
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def write_table(study: Study, path: Path) -> None:
    """Write the table to a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=COLUMNS)
        writer.writeheader()
        writer.writerows(table_rows(study))


def write_claims(study: Study, path: Path) -> None:
    """Write the claims, and what else was found, to a JSON file."""
    content = {
        "time_ps": TIME,
        "steps": study.steps,
        "openmm_version": openmm.Platform.getOpenMMVersion(),
        "claims": [asdict(claim) for claim in judge_claims(study)],
        "findings": [asdict(finding) for finding in other_findings(study)],
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def print_table(study: Study, console: Console) -> None:
    """Show the largest energy error of RATTLE and the gains of the methods."""
    title = "Largest energy error of RATTLE (kJ/mol), and that of RATTLE divided by that of each method"
    console.print(title, highlight=False)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("about so many steps", no_wrap=True)
    for number in study.steps:
        table.add_column(f"{number:,}", justify="right", no_wrap=True)
    table.add_row(RATTLE.name, *(two_digits(trial.fixed.largest_error) for trial in study.trials[U3.name]))
    for name, trials in study.trials.items():
        table.add_row(name, *(two_digits(t.gain) if t.variable.failure is None else "failed" for t in trials))
    console.print(table)


def print_claims(study: Study, console: Console) -> None:
    """Show one line for each claim of the paper, and one for each other finding."""
    console.print("What section 5 of the paper says:")
    for claim in judge_claims(study):
        verdict = Text("held: ", style="green") if claim.held else Text("did not hold: ", style="bold red")
        console.print(verdict + Text(f"{claim.claim} ({claim.meaning}: {_number(claim.number)})", style=""))
    console.print("What it does not say:")
    for finding in other_findings(study):
        console.print(f"{finding.finding}: {_number(finding.number)}", highlight=False)


def _number(value: float) -> str:
    """Three digits, for several of the numbers are near 1."""
    return f"{value:.3g}"


# ------------------------------------------------------------------------------------------------------- figures

# Colours that can be told apart with any colour vision (Okabe and Ito).
COLOURS = {
    RATTLE.name: "#555555",
    U3.name: "#D55E00",
    SMOOTH.name: "#E69F00",
    VECTOR_FIELD.name: "#56B4E9",
    U1.name: "#0072B2",
    U2.name: "#009E73",
    GAUSS.name: "#CC79A7",
}
SNAPSHOTS = (0.0, 0.08, 0.17, 0.3, 0.45, 0.6, 0.8, 1.0)
"""ps"""
SECTION_SCALE = 0.35
"""Sections are drawn smaller than they are, for they would hide each other."""


def _prepare(axes: Any) -> None:
    axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def draw_snapshots(study: Study) -> Figure:
    """Figure 5.2: the rod between the walls."""
    run = study.trials[U3.name][-1].variable
    figure = Figure(figsize=(9.6, 4.7), dpi=110, layout="constrained")
    for axes, time in zip(figure.subplots(2, 4, sharex=True, sharey=True).flat, SNAPSHOTS, strict=True):
        points = run.positions[np.argmin(np.abs(run.series.times - time))]
        centres = points.mean(axis=1)
        for centre, section in zip(centres, points, strict=True):
            corners = centre + SECTION_SCALE * (section - centre)
            corners = corners[[0, 1, 2, 0]]
            axes.fill(corners[:, 0], corners[:, 2], color="#56B4E9", alpha=0.35, linewidth=0)
            axes.plot(corners[:, 0], corners[:, 2], color="#0072B2", linewidth=0.7)
        axes.plot(centres[:, 0], centres[:, 2], "o-", color="black", markersize=2.5, linewidth=1.6)
        for side in (-1, 1):
            axes.axvspan(side * WALL, side * 0.85, color="#999999", alpha=0.5, linewidth=0)
        axes.set_title(f"t = {time:g} ps", fontsize=10.5)
        axes.set_aspect("equal")
        axes.set_xlim(-0.8, 0.8)
        axes.set_ylim(-0.15, 1.1)
        _prepare(axes)
    figure.supxlabel("x (nm)", fontsize=10.5)
    figure.supylabel("z (nm)", fontsize=10.5)
    return figure


def draw_total_energy(study: Study) -> Figure:
    """Figure 5.3: the total energy of RATTLE and VRATTLE with the same first step."""
    trial, same = study.same_step[FIRST_STEPS[0]]
    figure = Figure(figsize=(7.6, 3.8), dpi=110, layout="constrained")
    axes = figure.subplots()
    for name, run, marker in ((RATTLE.name, same, "x"), (U3.name, trial.variable, "+")):
        energies = run.initial_energy + run.series.energy_errors
        axes.plot(
            run.series.times, energies, marker=marker, markersize=4.5, linewidth=0.9, color=COLOURS[name], label=name
        )
    axes.set_xlim(0, TIME)
    axes.set_xlabel("time (ps)")
    axes.set_ylabel("total energy (kJ/mol)")
    axes.set_title(f"first step {FIRST_STEPS[0]:g} ps", fontsize=11)
    axes.legend(frameon=False, fontsize=9.5)
    _prepare(axes)
    return figure


def draw_energy_errors(study: Study) -> Figure:
    """Figure 5.4: the energy error of RATTLE, and of VRATTLE with as many and with half as many steps."""
    trials = [study.same_step[size][0] for size in FIRST_STEPS]
    fixed = trials[0].fixed
    label = f"RATTLE, steps of {fixed.first_step:.4f} ps: {fixed.steps} steps"
    runs: list[tuple[str, Run, dict[str, Any]]] = [(label, fixed, {"color": COLOURS[RATTLE.name]})]
    for trial, style in zip(trials, ({"linestyle": (0, (4, 1.5))}, {"color": "#0072B2"}), strict=True):
        run = trial.variable
        style = {"color": COLOURS[U3.name]} | style
        runs.append((f"U3, first step {run.first_step:g} ps: {run.steps} steps", run, style))
    figure = Figure(figsize=(7.6, 4.0), dpi=110, layout="constrained")
    axes = figure.subplots()
    for label, run, style in runs:
        axes.plot(run.series.times, run.series.energy_errors, linewidth=1.2, label=label, **style)
    axes.set_xlim(0, TIME)
    axes.set_xlabel("time (ps)")
    axes.set_ylabel("energy error E − E(0) (kJ/mol)")
    axes.legend(frameon=False, fontsize=9)
    _prepare(axes)
    return figure


def draw_work_and_error(study: Study) -> Figure:
    """Figure 5.5: the largest energy error against the number of steps."""
    figure = Figure(figsize=(6.4, 4.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    lines = {RATTLE.name: [(trial.fixed.steps, trial.fixed.largest_error) for trial in study.trials[U3.name]]}
    for name in list(COLOURS)[1:]:
        variable = [trial.variable for trial in study.trials[name]]
        lines[name] = [(run.steps, run.largest_error) for run in variable if run.failure is None]
    for name, points in lines.items():
        steps, errors = zip(*points, strict=True)
        wide = {"linewidth": 3.0, "alpha": 0.6, "marker": ""} if name == RATTLE.name else {"linewidth": 1.2}
        axes.plot(steps, errors, **({"marker": "o", "markersize": 4, "color": COLOURS[name], "label": name} | wide))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("steps")
    axes.set_ylabel("largest energy error (kJ/mol)")
    axes.legend(frameon=False, fontsize=9)
    _prepare(axes)
    return figure


def draw_starts(study: Study) -> Figure:
    """Figure 5.6: density and step size with three values of the density before the start."""
    starts = study.starts[LATER_START]
    figure = Figure(figsize=(9.6, 6.6), dpi=110, layout="constrained")
    panels = figure.subplots(3, 2, sharex=True, sharey="col")
    rows = (
        ("simple start, ρ = U(q0)", starts.simple, "#D55E00"),
        ("extrapolated start, ρ = (U(q-1) + U(q0))/2", starts.backward, "#0072B2"),
        ("the integrator's own start", starts.ours, "#009E73"),
    )
    for (left, right), (name, run, colour) in zip(panels, rows, strict=True):
        # A density belongs to the middle of its step.
        middles = 0.5 * (run.series.times[1:] + run.series.times[:-1])
        left.plot(middles, run.densities, ".-", markersize=3, linewidth=0.8, color=colour)
        right.plot(middles, run.series.step_sizes[1:], ".-", markersize=3, linewidth=0.8, color=colour)
        left.set_title(name, fontsize=10, loc="left")
        for axes in (left, right):
            _prepare(axes)
    panels[0, 0].set_xlim(LATER_START, 0.3)
    for axes, label in zip(panels[1], ("density ρ (1/nm³)", "step size (ps)"), strict=True):
        axes.set_ylabel(label)
    for axes in panels[-1]:
        axes.set_xlabel("time (ps)")
    return figure


FIGURES: dict[str, Callable[[Study], Figure]] = {
    "figure-5-2": draw_snapshots,
    "figure-5-3": draw_total_energy,
    "figure-5-4": draw_energy_errors,
    "figure-5-5": draw_work_and_error,
    "figure-5-6": draw_starts,
}
"""What draws each figure, by the name of its file."""


# ------------------------------------------------------------------------------------------------------ the script


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Section 5 of Barth, Leimkuhler and Reich (1999), reproduced.")
    parser.add_argument(
        "--output", type=Path, default=Path("out/elastic_rod"), help="folder of the files (default: %(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="runs of about 350 and 1,000 steps only")
    add_platform_arguments(parser, platform)
    options = parser.parse_args(arguments)
    try:
        options.platform = platform_from(options, "Reference")
    except ValueError as error:
        parser.error(f"{error}.")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, draw, print and write; returns the exit status."""
    global platform
    options = _arguments(arguments)
    platform = options.platform
    console = Console()
    try:
        options.output.mkdir(parents=True, exist_ok=True)
        with console.status("starting") as status:
            steps = QUICK_STEPS if options.quick else STEPS
            study = run_study(steps, lambda what: status.update(f"running {what}"))
            status.update("drawing")
            for name, draw in FIGURES.items():
                draw(study).savefig(options.output / f"{name}.png")
        write_table(study, options.output / "table.csv")
        write_claims(study, options.output / "claims.json")
    except (OSError, openmm.OpenMMException) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print_table(study, console)
    print_claims(study, console)
    console.print(f"Figures, table.csv and claims.json are in {options.output}.", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
