# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Run integrators on one system at an equal number of force evaluations and measure how well they keep the energy.

Every integrator starts from the same state and covers the same simulated time with, within 2 %, the same number of
force evaluations, which for molecules is the same cost:

- OpenMM's ``VerletIntegrator`` with fixed steps,
- OpenMM's ``VariableVerletIntegrator``, its error tolerance adjusted,
- ``VariableStepRattleIntegrator`` without a monitor, which is RATTLE with fixed steps: the control, since it differs
  from the next ones in nothing but the steps,
- ``VariableStepRattleIntegrator`` with the step controls recommended for the system, its nominal step adjusted.

Energies are those at whole steps. The velocities of OpenMM's leapfrog integrators lie half a step behind the positions;
the kinetic energy of a State allows for that, but its correction meets the velocity constraints to 1e-4 only, whatever
the tolerance. The error is of second order in that number, so it is far below every energy error of interest. The
leapfrog with fixed steps starts from velocities taken back by half a step, so that its energy at time 0 is that of all
others. (``VariableVerletIntegrator`` does so itself.)

This module computes; `openmmvrattle.plots` draws and ``python -m openmmvrattle compare`` prints.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmmvrattle import VariableStepRattleIntegrator

from .testsystems import ComparisonSettings, StepControl, TestSystem, constraint_error

__all__ = [
    "Comparison",
    "Envelope",
    "IntegratorRun",
    "Series",
    "compare",
    "envelope",
    "make_integrator",
    "quick_settings",
    "two_digits",
    "verdict",
    "write_json",
    "write_series",
    "write_summary",
]

EVALUATION_TOLERANCE = 0.02
"""Force evaluations count as equal if they differ by less than this fraction."""
MAXIMUM_ENERGY_SAMPLES = 100_000
"""Longer runs take the energy every few steps only."""
MAXIMUM_FAILED_TRIES = 5
"""An integrator whose steps are adjusted may fail this often before it is given up."""
MAXIMUM_CONSTRAINT_SAMPLES = 2_000
"""How often the constrained distances of a run are measured."""

Progress = Callable[[str, str, float], None]
"""Called with the name of an integrator, what is being done, and the fraction that is done."""


@dataclass(frozen=True)
class Series:
    """What was measured along a run; one entry for each sample."""

    times: np.ndarray
    """ps"""
    energy_errors: np.ndarray
    """Energy minus the energy at the start, in kJ/mol."""
    step_sizes: np.ndarray
    """The size of the step that led to the sample, in ps; NaN at time 0."""


@dataclass(frozen=True)
class IntegratorRun:
    """One integrator on one system. A failed run keeps what was measured before the failure."""

    name: str
    method: str
    """``fixed`` and ``variable``: OpenMM's own; ``control``: RATTLE with fixed steps; ``vrattle``: variable steps."""
    parameter: float
    """Step size or nominal step size in ps, or the error tolerance of VariableVerletIntegrator."""
    force_evaluations: int
    steps: int
    simulated_time: float
    """ps"""
    largest_energy_error: float
    """kJ/mol, of all samples"""
    rms_energy_error: float
    """kJ/mol, root of the time average of the squared error"""
    final_energy_error: float
    """kJ/mol, with its sign"""
    smallest_step: float
    """ps, of all steps"""
    largest_step: float
    """ps, of all steps"""
    largest_constraint_error: float
    """Relative error of a constrained distance, from at most 2000 points along the run."""
    seconds_per_step: float
    """Wall time of step(1), without the measurements between the steps."""
    energy_samples: int
    rescues: int
    """Steps at which the sum update of the step density had to be replaced, see getNumRescues()."""
    failure: str | None
    """Why the run did not reach its end, in one sentence."""
    series: Series = field(repr=False, compare=False)


@dataclass(frozen=True)
class Comparison:
    """All integrators on one system."""

    system_name: str
    description: str
    platform: str
    total_time: float
    """ps"""
    force_evaluations: int
    """What every integrator was given."""
    constraint_tolerance: float
    initial_energy: float
    """kJ/mol"""
    runs: tuple[IntegratorRun, ...]
    interrupted: bool = False

    def run_of(self, method: str) -> IntegratorRun | None:
        """The first run of a method that reached its end, or None."""
        return next((run for run in self.runs if run.method == method and run.failure is None), None)

    def best(self) -> IntegratorRun | None:
        """The run with the smallest largest energy error, or None if all failed."""
        finished = [run for run in self.runs if run.failure is None]
        return min(finished, key=lambda run: run.largest_energy_error) if finished else None

    def gain(self, run: IntegratorRun, reference: str = "control") -> float:
        """The largest energy error of fixed steps divided by that of a run.

        Args:
            run: the run to judge.
            reference: ``control`` for RATTLE with fixed steps, ``fixed`` for OpenMM's VerletIntegrator.

        Returns:
            The gain; above 1 the run is better. NaN if one of the two did not finish.
        """
        other = self.run_of(reference)
        if other is None or run.failure is not None:
            return math.nan
        return other.largest_energy_error / max(run.largest_energy_error, np.finfo(float).tiny)


class _RunError(Exception):
    """A run cannot go on; the message says why."""


@dataclass(frozen=True)
class _Method:
    """A kind of integrator with one free parameter that sets the number of steps."""

    name: str
    method: str
    make: Callable[[float], Any]
    """Makes the integrator from the parameter."""
    first_guess: float
    exponent: float
    """The number of steps is about proportional to the parameter to this power; 0 if the parameter is exact."""
    calibration_steps: int = 0
    """Trial steps before the run, which count as force evaluations."""


def quick_settings(settings: ComparisonSettings, fraction: float = 0.02, fewest: int = 100) -> ComparisonSettings:
    """The first part of a comparison, for a look that takes seconds: time and force evaluations both cut.

    Args:
        settings: the full settings.
        fraction: the part of the time that is kept.
        fewest: the smallest number of force evaluations, for which a larger part is kept if need be.
    """
    fraction = min(1.0, max(fraction, fewest / settings.force_evaluations))
    return replace(
        settings,
        total_time=settings.total_time * fraction,
        force_evaluations=round(settings.force_evaluations * fraction),
    )


def compare(
    test_system: TestSystem,
    platform: str = "Reference",
    settings: ComparisonSettings | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Run all integrators on a system.

    An integrator that fails is listed with its message, and the others go on. An interrupt from the keyboard ends the
    comparison with what was done so far.

    Args:
        test_system: the system and its start.
        platform: name of the OpenMM platform.
        settings: what to run; by default the settings recommended for the system.
        progress: called while the runs go on.
    """
    settings = settings or test_system.settings
    runs: list[IntegratorRun] = []
    interrupted = False
    try:
        for method in _methods(settings):
            report = _progress_of(method.name, progress)
            runs.append(_run_method(method, test_system, platform, settings, report))
            report("done", 1.0)
    except KeyboardInterrupt:
        interrupted = True
    return Comparison(
        system_name=test_system.name,
        description=test_system.description,
        platform=platform,
        total_time=settings.total_time,
        force_evaluations=settings.force_evaluations,
        constraint_tolerance=settings.constraint_tolerance,
        initial_energy=_initial_energy(test_system, platform),
        runs=tuple(runs),
        interrupted=interrupted,
    )


def two_digits(value: float) -> str:
    """A number with two significant digits, without an exponent where it is easy to read so."""
    if not math.isfinite(value):
        return "-"
    rounded = float(f"{value:.2g}")
    return f"{rounded:,.0f}" if 100 <= abs(rounded) < 1e6 else f"{rounded:.2g}"


def verdict(comparison: Comparison) -> list[str]:
    """What the numbers say, in plain sentences: also where variable steps lose."""
    sentences = []
    best = comparison.best()
    if best is None:
        return ["No integrator reached the end."]
    sentences.append(f"Smallest largest energy error: {best.name}, {two_digits(best.largest_energy_error)} kJ/mol.")
    for run in comparison.runs:
        if run.method == "vrattle" and run.failure is None:
            sentences.append(_judgement(comparison, run))
    inexact = [
        run
        for run in comparison.runs
        if run.method in ("fixed", "variable")
        and run.failure is None
        and run.largest_constraint_error > 10 * comparison.constraint_tolerance
    ]
    for run in inexact:
        sentences.append(
            f"{run.name} misses its constraints by up to {run.largest_constraint_error:.1e} (tolerance "
            f"{comparison.constraint_tolerance:.0e}): part of its energy error comes from OpenMM's constraint "
            "solver and not from its steps, so judge step control by RATTLE with fixed steps."
        )
    sentences.extend(
        f"{run.name} failed: {run.failure.rstrip('.')}." for run in comparison.runs if run.failure is not None
    )
    if comparison.interrupted:
        sentences.append("The comparison was interrupted and is not complete.")
    return sentences


def _judgement(comparison: Comparison, run: IntegratorRun) -> str:
    against_control = comparison.gain(run, "control")
    against_openmm = comparison.gain(run, "fixed")
    numbers = []
    if math.isfinite(against_control):
        numbers.append(f"{two_digits(against_control)} over RATTLE with fixed steps")
    if math.isfinite(against_openmm):
        numbers.append(f"{two_digits(against_openmm)} over VerletIntegrator")
    if not numbers:
        return f"{run.name} reached the end, where no integrator with fixed steps did."
    gain = against_control if math.isfinite(against_control) else against_openmm
    if gain > 1.25:
        words = "Variable steps win"
    elif gain > 0.8:
        words = "No difference worth the name"
    else:
        words = "Fixed steps win"
    return f"{words}: the gain of {run.name} (their largest energy error divided by its own) is {', '.join(numbers)}."


def _methods(settings: ComparisonSettings) -> list[_Method]:
    step = settings.total_time / settings.force_evaluations
    methods = [
        _Method("VerletIntegrator", "fixed", openmm.VerletIntegrator, step, 0.0),
        _Method("VariableVerletIntegrator", "variable", openmm.VariableVerletIntegrator, 1e-4, -0.5),
    ]
    fixed = StepControl(monitors=(), nominal_step_size=step)
    for control in (fixed, *settings.controls):
        methods.append(
            _Method(
                control.label,
                "vrattle" if control.monitors else "control",
                lambda size, control=control: make_integrator(control, size),
                control.nominal_step_size,
                -1.0 if control.monitors else 0.0,
                control.calibration_steps,
            )
        )
    return methods


def make_integrator(control: StepControl, nominal_step_size: float | None = None) -> VariableStepRattleIntegrator:
    """A VariableStepRattleIntegrator with the settings of a step control.

    Args:
        control: monitors, bounds and update of the step density.
        nominal_step_size: ps; by default that of the control. The bounds keep their ratio to it.
    """
    nominal = control.nominal_step_size if nominal_step_size is None else nominal_step_size
    integrator = VariableStepRattleIntegrator(nominal)
    integrator.clearMonitors()
    for monitor in control.monitors:
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, monitor.kind), monitor.weight, monitor.power)
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, control.update_method))
    integrator.setMinimumStepSize(control.smallest_step_ratio * nominal)
    integrator.setMaximumStepSize(control.largest_step_ratio * nominal)
    return integrator


def _run_method(
    method: _Method, test_system: TestSystem, platform: str, settings: ComparisonSettings, report: Callable
) -> IntegratorRun:
    """Adjust the free parameter, then run and measure."""
    try:
        parameter = _adjust(method, test_system, platform, settings, report)
    except _RunError as error:
        return _failed_run(method, str(error))
    return _measure(method, parameter, test_system, platform, settings, report)


def _adjust(
    method: _Method, test_system: TestSystem, platform: str, settings: ComparisonSettings, report: Callable
) -> float:
    """The parameter with which the method takes the wanted number of steps, within the tolerance.

    The number of steps is nearly a power of the parameter: a secant in the logarithms of both, within the bracket that
    is known so far.
    """
    if method.exponent == 0.0:
        return method.first_guess
    target = math.log(settings.force_evaluations)
    parameter, exponent = math.log(method.first_guess), method.exponent
    tried: list[tuple[float, float]] = []
    failed: list[tuple[float, _RunError]] = []
    for attempt in range(12):
        report(f"adjusting, try {attempt + 1}", 0.0)
        try:
            count = _count_steps(method, math.exp(parameter), test_system, platform, settings)
        except _RunError as error:
            # Too large steps can fail: try with twice as many, then four times as many again, and so on.
            failed.append((parameter, error))
            if len(failed) == MAXIMUM_FAILED_TRIES:
                raise
            longest = max((p for p, c in tried if c > target), default=None)
            smaller = parameter + len(failed) * math.log(2.0) / exponent
            parameter = smaller if longest is None else (longest + parameter) / 2
            continue
        if abs(count / settings.force_evaluations - 1.0) < EVALUATION_TOLERANCE / 2:
            return math.exp(parameter)
        tried.append((parameter, math.log(count)))
        if len(tried) > 1 and tried[-1][0] != tried[-2][0]:
            slope = (tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0])
            if 0.3 < slope / method.exponent < 3.0:
                exponent = slope
        parameter += (target - tried[-1][1]) / exponent
        # Steps fall with the parameter: stay between the nearest tries on both sides.
        too_many = [p for p, c in tried if c > target]
        too_few = [p for p, c in tried if c < target] + [p for p, _ in failed]
        if too_many and too_few and not max(too_many) < parameter < min(too_few):
            parameter = (max(too_many) + min(too_few)) / 2
    nearest = min(tried, key=lambda pair: abs(pair[1] - target))
    if abs(math.exp(nearest[1] - target) - 1.0) > EVALUATION_TOLERANCE:
        if failed:
            raise failed[-1][1]
        raise _RunError(
            f"its steps could not be adjusted to {settings.force_evaluations} force evaluations; the nearest was "
            f"{round(math.exp(nearest[1]))}"
        )
    return math.exp(nearest[0])


def _count_steps(
    method: _Method, parameter: float, test_system: TestSystem, platform: str, settings: ComparisonSettings
) -> float:
    """The number of force evaluations over the whole time, those of a calibration included.

    A run that takes far too many steps is cut short and extrapolated.
    """
    integrator, context = _start(method, parameter, test_system, platform, settings)
    limit = 2 * settings.force_evaluations
    steps, simulated = 0, 0.0
    while simulated < _end_of(settings) and steps < limit:
        simulated += _checked_step(integrator, simulated)
        steps += 1
    del context
    needed = steps if simulated >= _end_of(settings) else steps * settings.total_time / simulated
    return needed + method.calibration_steps


def _measure(
    method: _Method,
    parameter: float,
    test_system: TestSystem,
    platform: str,
    settings: ComparisonSettings,
    report: Callable,
) -> IntegratorRun:
    """Run once to the end and measure energies, constraints, steps and time."""
    try:
        integrator, context = _start(method, parameter, test_system, platform, settings)
    except _RunError as error:
        return replace(_failed_run(method, str(error)), parameter=parameter)
    evaluations = settings.force_evaluations
    energy_interval = math.ceil(evaluations / MAXIMUM_ENERGY_SAMPLES)
    constraint_interval = math.ceil(evaluations / MAXIMUM_CONSTRAINT_SAMPLES)
    end, limit = _end_of(settings), 2 * evaluations
    initial_energy = _energy(context)
    times, errors, sizes = [0.0], [0.0], [math.nan]
    simulated, steps, seconds, largest_constraint_error = 0.0, 0, 0.0, 0.0
    smallest, largest = math.inf, 0.0
    failure = None
    try:
        while simulated < end:
            before = time.perf_counter()
            size = _checked_step(integrator, simulated)
            seconds += time.perf_counter() - before
            simulated += size
            steps += 1
            smallest, largest = min(smallest, size), max(largest, size)
            last = simulated >= end
            if steps % energy_interval == 0 or last:
                times.append(simulated)
                errors.append(_checked_energy(context, simulated) - initial_energy)
                sizes.append(size)
            if steps % constraint_interval == 0 or last:
                largest_constraint_error = max(largest_constraint_error, _constraint_error(test_system, context))
                if largest_constraint_error >= 1.0:
                    raise _RunError(f"at {simulated:.4g} ps it had lost its constraints")
                report("running", simulated / settings.total_time)
            if steps >= limit and not last:
                raise _RunError(f"it had done only {simulated:.4g} ps after {steps} steps")
    except _RunError as error:
        failure = str(error)
    if steps == 0:
        return replace(_failed_run(method, failure or "it took no step"), parameter=parameter)
    series = Series(np.array(times), np.array(errors), np.array(sizes))
    ours = method.method in ("control", "vrattle")
    return IntegratorRun(
        name=method.name,
        method=method.method,
        parameter=parameter,
        force_evaluations=int(integrator.getNumForceEvaluations()) if ours else steps,
        steps=steps,
        simulated_time=simulated,
        largest_energy_error=float(np.max(np.abs(series.energy_errors))),
        rms_energy_error=_time_weighted_rms(series),
        final_energy_error=float(series.energy_errors[-1]),
        smallest_step=smallest,
        largest_step=largest,
        largest_constraint_error=largest_constraint_error,
        seconds_per_step=seconds / steps,
        energy_samples=len(times),
        rescues=int(integrator.getNumRescues()) if ours else 0,
        failure=failure,
        series=series,
    )


def _failed_run(method: _Method, message: str) -> IntegratorRun:
    nan = math.nan
    empty = np.array([])
    return IntegratorRun(
        name=method.name,
        method=method.method,
        parameter=nan,
        force_evaluations=0,
        steps=0,
        simulated_time=0.0,
        largest_energy_error=nan,
        rms_energy_error=nan,
        final_energy_error=nan,
        smallest_step=nan,
        largest_step=nan,
        largest_constraint_error=nan,
        seconds_per_step=nan,
        energy_samples=0,
        rescues=0,
        failure=message,
        series=Series(empty, empty, empty),
    )


def _start(
    method: _Method, parameter: float, test_system: TestSystem, platform: str, settings: ComparisonSettings
) -> tuple[Any, openmm.Context]:
    """An integrator and its context in the initial state of the system."""
    try:
        integrator = method.make(parameter)
        integrator.setConstraintTolerance(settings.constraint_tolerance)
        context = openmm.Context(test_system.system, integrator, openmm.Platform.getPlatformByName(platform))
        context.setPositions(test_system.positions)
        velocities = test_system.velocities
        if method.method == "fixed":
            velocities = _half_step_back(test_system, context, parameter)
        context.setVelocities(velocities)
        if method.calibration_steps:
            integrator.calibrate(method.calibration_steps)
    except Exception as error:
        raise _RunError(_sentence(error)) from error
    return integrator, context


def _half_step_back(test_system: TestSystem, context: openmm.Context, step: float) -> np.ndarray:
    """The velocities that a leapfrog integrator needs half a step before the start.

    The constraint forces can be left out: they change the velocities only along the directions that the first step
    removes anyway.
    """
    forces = context.getState(getForces=True).getForces(asNumpy=True)
    forces = forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    system = test_system.system
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    inverse_masses = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    return test_system.velocities - 0.5 * step * forces * inverse_masses[:, None]


def _checked_step(integrator: Any, simulated: float) -> float:
    """Take one step and return its size in ps.

    The sizes are summed by the caller, because the time of a context becomes infinite when VariableVerletIntegrator
    reaches its largest step.
    """
    try:
        integrator.step(1)
    except Exception as error:
        raise _RunError(f"at {simulated:.4g} ps: {_sentence(error)}") from error
    size = integrator.getStepSize()
    size = size._value if unit.is_quantity(size) else size
    if not 0.0 < size < math.inf:
        what = "infinite, for want of an applied force to take it from" if size == math.inf else f"{size}"
        raise _RunError(f"at {simulated:.4g} ps its step size became {what}")
    return size


def _checked_energy(context: openmm.Context, simulated: float) -> float:
    try:
        energy = _energy(context)
    except Exception as error:
        raise _RunError(f"at {simulated:.4g} ps: {_sentence(error)}") from error
    if not math.isfinite(energy):
        raise _RunError(f"at {simulated:.4g} ps the energy is not a number any more")
    return energy


def _energy(context: openmm.Context) -> float:
    """Kinetic plus potential energy at the time of the positions, in kJ/mol."""
    state = context.getState(getEnergy=True)
    return state.getKineticEnergy()._value + state.getPotentialEnergy()._value


def _constraint_error(test_system: TestSystem, context: openmm.Context) -> float:
    positions = context.getState(getPositions=True).getPositions(asNumpy=True)._value
    return constraint_error(test_system.system, positions)


def _initial_energy(test_system: TestSystem, platform: str) -> float:
    integrator = openmm.VerletIntegrator(1e-6)
    context = openmm.Context(test_system.system, integrator, openmm.Platform.getPlatformByName(platform))
    context.setPositions(test_system.positions)
    system = test_system.system
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    kinetic = 0.5 * float(np.sum(masses[:, None] * test_system.velocities**2))
    return kinetic + context.getState(getEnergy=True).getPotentialEnergy()._value


def _end_of(settings: ComparisonSettings) -> float:
    """The end of the run, less a part in 1e9 for the rounding of a sum of many steps."""
    return settings.total_time * (1.0 - 1e-9)


def _time_weighted_rms(series: Series) -> float:
    """The root of the time average of the squared energy error; each sample stands for the time before it."""
    durations = np.diff(series.times)
    if not len(durations) or not durations.sum() > 0:
        return 0.0
    return float(np.sqrt(np.sum(durations * series.energy_errors[1:] ** 2) / durations.sum()))


def _sentence(error: Exception) -> str:
    """The message of an exception in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _progress_of(name: str, progress: Progress | None) -> Callable[[str, float], None]:
    def report(activity: str, fraction: float) -> None:
        if progress is not None:
            progress(name, activity, min(1.0, fraction))

    return report


@dataclass(frozen=True)
class Envelope:
    """A series reduced to windows of equal simulated time, without losing its peaks."""

    times: np.ndarray
    """Middle of each window, ps."""
    largest_energy_errors: np.ndarray
    """The energy error of largest size in the window, with its sign, kJ/mol."""
    smallest_energy_errors: np.ndarray
    """The energy error of smallest size in the window, with its sign, kJ/mol."""
    smallest_steps: np.ndarray
    """ps"""
    largest_steps: np.ndarray
    """ps"""


def envelope(series: Series, total_time: float, windows: int = 2000) -> Envelope:
    """Reduce a series to windows of equal simulated time; windows into which no sample falls are left out.

    Args:
        series: the samples; that at time 0 is left out.
        total_time: the time that is divided into windows, ps.
        windows: the number of windows.
    """
    if len(series.times) < 2:
        empty = np.array([])
        return Envelope(empty, empty, empty, empty, empty)
    times, errors, steps = series.times[1:], series.energy_errors[1:], series.step_sizes[1:]
    index = np.clip((times / total_time * windows).astype(int), 0, windows - 1)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(index)) + 1])
    sizes = np.abs(errors)
    pieces = [slice(a, b) for a, b in zip(starts, [*starts[1:], len(times)], strict=True)]
    return Envelope(
        times=(index[starts] + 0.5) * total_time / windows,
        largest_energy_errors=np.array([errors[p][np.argmax(sizes[p])] for p in pieces]),
        smallest_energy_errors=np.array([errors[p][np.argmin(sizes[p])] for p in pieces]),
        smallest_steps=np.minimum.reduceat(steps, starts),
        largest_steps=np.maximum.reduceat(steps, starts),
    )


_SUMMARY_FIELDS = tuple(name for name in IntegratorRun.__dataclass_fields__ if name != "series")


def _summary_of(comparison: Comparison, run: IntegratorRun) -> dict[str, Any]:
    row = {name: getattr(run, name) for name in _SUMMARY_FIELDS}
    row["gain_over_fixed_rattle"] = comparison.gain(run, "control")
    row["gain_over_verlet"] = comparison.gain(run, "fixed")
    return row


def write_summary(comparisons: Sequence[Comparison], path: Path) -> None:
    """Write one line for each run of each system to a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = None
        for comparison in comparisons:
            for run in comparison.runs:
                row = {"system": comparison.system_name, **_summary_of(comparison, run)}
                if writer is None:
                    writer = csv.DictWriter(file, fieldnames=list(row))
                    writer.writeheader()
                writer.writerow(row)


def write_series(comparison: Comparison, path: Path, windows: int = 2000) -> None:
    """Write the course of each run to a CSV file, reduced to windows of equal time that keep the peaks."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["integrator", "time_ps", "energy_error_kj_per_mol", "smallest_step_ps", "largest_step_ps"])
        for run in comparison.runs:
            reduced = envelope(run.series, comparison.total_time, windows)
            columns = (reduced.times, reduced.largest_energy_errors, reduced.smallest_steps, reduced.largest_steps)
            for values in zip(*columns, strict=True):
                writer.writerow([run.name, *(f"{value:.9g}" for value in values)])


def write_json(comparison: Comparison, path: Path) -> None:
    """Write settings, numbers and verdict of a comparison to a JSON file; a number that does not exist is null."""
    content = asdict(replace(comparison, runs=()))
    content["openmm_version"] = openmm.Platform.getOpenMMVersion()
    content["runs"] = [_summary_of(comparison, run) for run in comparison.runs]
    content["verdict"] = verdict(comparison)
    path.write_text(json.dumps(_without_nan(content), indent=2) + "\n", encoding="utf-8")


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
