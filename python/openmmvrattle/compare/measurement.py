# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""One integrator on one system: its free parameter is adjusted, then it runs and its energy is measured.

`openmmvrattle.compare.comparison` puts several of these runs side by side and says what they mean.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmmvrattle import CustomVariableStepRattleIntegrator, VariableStepRattleIntegrator

from .._constraint_errors import ConstraintErrors
from ..platforms import make_context
from ..testsystems import ComparisonSettings, StepControl, TestSystem

__all__ = [
    "DEFAULT_INTEGRATORS",
    "INTEGRATORS",
    "IntegratorRun",
    "Method",
    "Progress",
    "Series",
    "failed_run",
    "initial_energy",
    "make_integrator",
    "methods_of",
    "run_method",
    "run_to_accuracy",
]

EVALUATION_TOLERANCE = 0.02
"""Force evaluations count as equal if they differ by less than this fraction."""
ACCURACY_TOLERANCE = 0.05
"""The number of force evaluations that a wanted energy error needs is found to this fraction."""
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
    """Relative error of a constraint, a distance or an expression, from at most 2000 points along the run."""
    seconds_per_step: float
    """Wall time of step(1), without the measurements between the steps."""
    energy_samples: int
    rescues: int
    """Steps at which the sum update of the step density had to be replaced, see getNumRescues()."""
    failure: str | None
    """Why the run did not reach its end, in one sentence."""
    series: Series = field(repr=False, compare=False)


class _RunError(Exception):
    """A run cannot go on; the message says why."""


@dataclass(frozen=True)
class Method:
    """A kind of integrator with one free parameter that sets the number of steps. It can be sent to other processes."""

    name: str
    """How tables and pictures call it."""
    method: str
    """The kind, as in `IntegratorRun.method`."""
    make: Callable[[float], Any]
    """Makes the integrator from the parameter."""
    first_guess: float
    exponent: float
    """The number of steps is about proportional to the parameter to this power."""
    is_exact: bool = False
    """Whether the first guess gives the wanted number of steps, as a fixed step does."""
    calibration_steps: int = 0
    """Trial steps before the run, which count as force evaluations."""
    update_method: str | None = None
    """The recursion of the step density, where there is one."""


def _verlet(settings: ComparisonSettings) -> list[Method]:
    return [Method("VerletIntegrator", "fixed", openmm.VerletIntegrator, _mean_step(settings), -1.0, is_exact=True)]


def _variable_verlet(settings: ComparisonSettings) -> list[Method]:
    return [Method("VariableVerletIntegrator", "variable", openmm.VariableVerletIntegrator, 1e-4, -0.5)]


def _rattle(settings: ComparisonSettings) -> list[Method]:
    control = StepControl(monitors=(), nominal_step_size=_mean_step(settings))
    make = functools.partial(make_integrator, control)
    return [Method(control.label, "control", make, control.nominal_step_size, -1.0, is_exact=True)]


def _automatic(settings: ComparisonSettings) -> list[Method]:
    control = StepControl(monitors=(), nominal_step_size=_mean_step(settings), automatic=True)
    make = functools.partial(make_integrator, control)
    return [Method(control.label, "vrattle", make, control.nominal_step_size, -1.0)]


def _vrattle(settings: ComparisonSettings) -> list[Method]:
    return [
        Method(
            label,
            "vrattle" if control.monitors else "control",
            functools.partial(make_integrator, control),
            control.nominal_step_size,
            -1.0,
            is_exact=not control.monitors,
            calibration_steps=control.calibration_steps,
            update_method=control.update_method if control.monitors else None,
        )
        for control, label in zip(settings.controls, _distinct_labels(settings.controls), strict=True)
    ]


def _custom(settings: ComparisonSettings) -> list[Method]:
    methods = []
    for method, control in zip(_vrattle(settings), settings.controls, strict=True):
        name = method.name.replace("VRATTLE", "VRATTLE (custom)")
        of_constraints = any(monitor.kind.startswith("Constraint") for monitor in control.monitors)
        if of_constraints and control.update_method == "Explicit":  # which the class does not have for them
            control = replace(control, update_method="SemiExplicit")
            name = f"{name.removesuffix(', Explicit')}, SemiExplicit"
        make = functools.partial(make_integrator, control, kind=CustomVariableStepRattleIntegrator)
        methods.append(replace(method, name=name, make=make, update_method=control.update_method))
    return methods


INTEGRATORS: dict[str, Callable[[ComparisonSettings], list[Method]]] = {
    "VerletIntegrator": _verlet,
    "VariableVerletIntegrator": _variable_verlet,
    "RATTLE": _rattle,
    "VRATTLE": _vrattle,
    "Automatic": _automatic,
    "CustomVRATTLE": _custom,
}
"""What can be compared, by name; each value gives the methods to run for the settings. ``RATTLE`` is our integrator
without a monitor, which has fixed steps; ``VRATTLE`` is the same with each of the step controls of the settings, and
``Automatic`` with the automatic step control. ``CustomVRATTLE`` is CustomVariableStepRattleIntegrator."""
DEFAULT_INTEGRATORS = ("VerletIntegrator", "VariableVerletIntegrator", "RATTLE", "VRATTLE", "Automatic")
"""What is compared if nothing is said."""


def methods_of(settings: ComparisonSettings, integrators: Iterable[str] | None = None) -> list[Method]:
    """The methods to run.

    Args:
        settings: total time, force evaluations and step controls.
        integrators: names out of `INTEGRATORS`; by default `DEFAULT_INTEGRATORS`.
    """
    return [method for name in integrators or DEFAULT_INTEGRATORS for method in INTEGRATORS[name](settings)]


def _mean_step(settings: ComparisonSettings) -> float:
    return settings.total_time / settings.force_evaluations


def _distinct_labels(controls: Sequence[StepControl]) -> list[str]:
    """The labels of step controls, with what sets apart those that would have the same."""
    labels = [control.label for control in controls]
    for describe in (lambda c: c.update_method, _bounds_of, lambda c: f"calibrated with {c.calibration_steps} steps"):
        for label in {label for label in labels if labels.count(label) > 1}:
            same = [i for i, other in enumerate(labels) if other == label]
            if len({describe(controls[i]) for i in same}) > 1:
                for i in same:
                    labels[i] = f"{label}, {describe(controls[i])}"
    return labels


def _bounds_of(control: StepControl) -> str:
    return f"bounds {control.smallest_step_ratio:.3g} and {control.largest_step_ratio:.3g}"


def make_integrator(
    control: StepControl, nominal_step_size: float | None = None, kind: type = VariableStepRattleIntegrator
) -> Any:
    """A VariableStepRattleIntegrator with the settings of a step control.

    Args:
        control: monitors, bounds and update of the step density.
        nominal_step_size: ps; by default that of the control. The bounds keep their ratio to it.
        kind: CustomVariableStepRattleIntegrator for one of that class.
    """
    nominal = control.nominal_step_size if nominal_step_size is None else nominal_step_size
    integrator = kind(nominal)
    if control.automatic:
        integrator.useAutomaticStepControl()
        return integrator
    integrator.clearMonitors()
    for monitor in control.monitors:
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, monitor.kind), monitor.weight, monitor.power)
    for index, value in enumerate(control.reference_values):
        integrator.setReferenceMonitorValue(value, index)
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, control.update_method))
    integrator.setMinimumStepSize(control.smallest_step_ratio * nominal)
    integrator.setMaximumStepSize(control.largest_step_ratio * nominal)
    return integrator


def run_method(
    method: Method,
    test_system: TestSystem,
    platform: str,
    settings: ComparisonSettings,
    progress: Progress | None = None,
) -> IntegratorRun:
    """Adjust the free parameter of a method to the wanted number of force evaluations, then run and measure.

    Whatever goes wrong is told in the run that is returned.

    Args:
        method: what to run.
        test_system: the system and its start.
        platform: name of the OpenMM platform, as for `openmmvrattle.platforms`.
        settings: simulated time and number of force evaluations.
        progress: called while the run goes on.
    """
    report = _progress_of(method.name, progress)
    try:
        parameter = _adjust(method, test_system, platform, settings, report)
    except _RunError as error:
        return failed_run(method, str(error))
    return _measure(method, parameter, test_system, platform, settings, report)


def run_to_accuracy(
    method: Method,
    test_system: TestSystem,
    platform: str,
    settings: ComparisonSettings,
    wanted_error: float,
    most_evaluations: int | None = None,
    progress: Progress | None = None,
) -> IntegratorRun:
    """Find how many force evaluations a method needs to keep its largest energy error below a wanted one.

    The error falls about with the square of the number of evaluations: a secant in the logarithms of both, within the
    bracket that is known so far, until the number is known to `ACCURACY_TOLERANCE`. Where the error does not fall
    steadily, as on chaotic motion, the number is one at which it is small enough while it is too large just below.

    Args:
        method: what to run.
        test_system: the system and its start.
        platform: name of the OpenMM platform, as for `openmmvrattle.platforms`.
        settings: simulated time, and the number of evaluations to begin with.
        wanted_error: kJ/mol.
        most_evaluations: the largest number that is tried; by default 20 times that of the settings.
        progress: called while the runs go on.

    Returns:
        The run with the fewest evaluations that was good enough, or a failed run.
    """
    report = _progress_of(method.name, progress)
    most = most_evaluations or 20 * settings.force_evaluations
    effort = method.exponent * math.log(method.first_guess)  # the logarithm of the evaluations, but for a constant
    poor: list[tuple[float, IntegratorRun]] = []
    good: list[tuple[float, IntegratorRun]] = []
    expected = float(settings.force_evaluations)
    for attempt in range(20):
        report(f"searching, try {attempt + 1}", 0.0)
        run = _measure(
            method,
            math.exp(effort / method.exponent),
            test_system,
            platform,
            replace(settings, force_evaluations=max(1, min(round(expected), most))),
            report,
            most_steps=2 * most,
        )
        is_good = run.failure is None and run.largest_energy_error <= wanted_error
        (good if is_good else poor).append((effort, run))
        following = _next_effort(good, poor, wanted_error, most)
        if following is None:
            break
        expected = max(10.0, run.force_evaluations) * math.exp(min(20.0, abs(following - effort)))
        effort = following
    if good:
        return min(good)[1]
    last = max(poor)[1]
    if last.failure is not None:
        return last
    reason = (
        f"it needs more than {most:,} force evaluations; with {last.force_evaluations:,} its largest energy error is "
        f"{last.largest_energy_error:.2g} kJ/mol"
    )
    return replace(last, failure=reason)


def _next_effort(
    good: list[tuple[float, IntegratorRun]], poor: list[tuple[float, IntegratorRun]], wanted_error: float, most: int
) -> float | None:
    """The logarithm of the number of evaluations to try next, or None if the search is over."""
    if good and poor:
        (least, best), (enough, _) = min(good, key=lambda pair: pair[0]), max(poor, key=lambda pair: pair[0])
        below = [pair for pair in poor if pair[0] < least]
        if not below:
            return None
        enough, nearest = max(below, key=lambda pair: pair[0])
        width = least - enough
        if width < ACCURACY_TOLERANCE or best.largest_energy_error > wanted_error * (1.0 - ACCURACY_TOLERANCE):
            return None
        if nearest.failure is not None:
            return enough + width / 2
        fall = math.log(nearest.largest_energy_error / max(best.largest_energy_error, 1e-300))
        part = math.log(nearest.largest_energy_error / wanted_error) / fall
        return enough + width * min(0.9, max(0.1, part + 0.02))
    if good:
        least, best = min(good, key=lambda pair: pair[0])
        if best.force_evaluations <= 20:
            return None
        error = max(best.largest_energy_error, 1e-300)
        return least - min(math.log(8.0), max(0.05, 0.5 * math.log(wanted_error / error)))
    enough, nearest = max(poor, key=lambda pair: pair[0])
    if nearest.failure is not None:
        # Too large steps can fail: twice as many, then four times as many again, and so on.
        return enough + len(poor) * math.log(2.0) if len(poor) < MAXIMUM_FAILED_TRIES else None
    room = math.log(most / max(1, nearest.force_evaluations))
    if room < ACCURACY_TOLERANCE:
        return None
    wanted = 0.5 * math.log(nearest.largest_energy_error / wanted_error) + 0.03
    return enough + min(math.log(8.0), max(0.05, wanted), room)


def _adjust(
    method: Method, test_system: TestSystem, platform: str, settings: ComparisonSettings, report: Callable
) -> float:
    """The parameter with which the method takes the wanted number of steps, within the tolerance.

    The number of steps is nearly a power of the parameter: a secant in the logarithms of both, within the bracket that
    is known so far.
    """
    if method.is_exact:
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
    method: Method, parameter: float, test_system: TestSystem, platform: str, settings: ComparisonSettings
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
    method: Method,
    parameter: float,
    test_system: TestSystem,
    platform: str,
    settings: ComparisonSettings,
    report: Callable,
    most_steps: int | None = None,
) -> IntegratorRun:
    """Run once to the end and measure energies, constraints, steps and time.

    A run that takes more than `most_steps`, by default twice the force evaluations of the settings, is given up.
    """
    try:
        integrator, context = _start(method, parameter, test_system, platform, settings)
    except _RunError as error:
        return replace(failed_run(method, str(error)), parameter=parameter)
    evaluations = settings.force_evaluations
    energy_interval = math.ceil(evaluations / MAXIMUM_ENERGY_SAMPLES)
    constraint_interval = math.ceil(evaluations / MAXIMUM_CONSTRAINT_SAMPLES)
    end, limit = _end_of(settings), most_steps or 2 * evaluations
    constraint_errors = ConstraintErrors(
        test_system.system,
        [(c.expression, c.particles, dict(c.parameters)) for c in test_system.expression_constraints],
    )
    energy_at_start = _energy(test_system, context)
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
                errors.append(_checked_energy(test_system, context, simulated) - energy_at_start)
                sizes.append(size)
            if steps % constraint_interval == 0 or last:
                positions = context.getState(getPositions=True).getPositions(asNumpy=True)._value
                largest_constraint_error = max(largest_constraint_error, constraint_errors.largest(positions))
                if largest_constraint_error >= 1.0:
                    raise _RunError(f"at {simulated:.4g} ps it had lost its constraints")
                report("running", simulated / settings.total_time)
            if steps >= limit and not last:
                raise _RunError(f"it had done only {simulated:.4g} ps after {steps} steps")
    except _RunError as error:
        failure = str(error)
    if steps == 0:
        return replace(failed_run(method, failure or "it took no step"), parameter=parameter)
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


def failed_run(method: Method, message: str) -> IntegratorRun:
    """The row of a method that could not be run at all."""
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
    method: Method, parameter: float, test_system: TestSystem, platform: str, settings: ComparisonSettings
) -> tuple[Any, openmm.Context]:
    """An integrator and its context in the initial state of the system."""
    try:
        integrator = method.make(parameter)
        integrator.setConstraintTolerance(settings.constraint_tolerance)
        test_system.prepare(integrator)
        context = make_context(test_system.system, integrator, platform)
        for name, value in test_system.parameters:
            context.setParameter(name, value)
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
    forces = context.getState(getForces=True, groups=test_system.force_groups).getForces(asNumpy=True)
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


def _checked_energy(test_system: TestSystem, context: openmm.Context, simulated: float) -> float:
    try:
        energy = _energy(test_system, context)
    except Exception as error:
        raise _RunError(f"at {simulated:.4g} ps: {_sentence(error)}") from error
    if not math.isfinite(energy):
        raise _RunError(f"at {simulated:.4g} ps the energy is not a number any more")
    return energy


def _energy(test_system: TestSystem, context: openmm.Context) -> float:
    """Kinetic plus potential energy at the time of the positions, in kJ/mol."""
    state = context.getState(getEnergy=True, groups=test_system.force_groups)
    return state.getKineticEnergy()._value + state.getPotentialEnergy()._value


def initial_energy(test_system: TestSystem, platform: str) -> float:
    """The energy at the start, in kJ/mol, from the velocities as they are."""
    integrator = openmm.VerletIntegrator(1e-6)
    context = make_context(test_system.system, integrator, platform)
    for name, value in test_system.parameters:
        context.setParameter(name, value)
    context.setPositions(test_system.positions)
    system = test_system.system
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    kinetic = 0.5 * float(np.sum(masses[:, None] * test_system.velocities**2))
    state = context.getState(getEnergy=True, groups=test_system.force_groups)
    return kinetic + state.getPotentialEnergy()._value


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
