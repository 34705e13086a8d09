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

This module computes; `openmmvrattle.compare.plots` draws and ``python -m openmmvrattle compare`` prints.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm

from ..testsystems import ComparisonSettings, TestSystem
from .measurement import (
    IntegratorRun,
    Method,
    Progress,
    Series,
    failed_run,
    initial_energy,
    methods_of,
    run_method,
    run_to_accuracy,
)
from .measurement import make_integrator as make_integrator  # scripts look for it here

__all__ = [
    "Case",
    "Comparison",
    "Envelope",
    "compare",
    "envelope",
    "quick_settings",
    "run_case",
    "two_digits",
    "verdict",
    "write_json",
    "write_series",
    "write_summary",
]


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
    label: str = ""
    """The name of its files, which is that of the system and what sets it apart from other comparisons of it."""
    seed: int | None = None
    """Of the random start, if one was chosen."""
    wanted_error: float | None = None
    """In kJ/mol; if given, each integrator got as many force evaluations as it needs for this energy error."""
    notes: tuple[str, ...] = ()
    """What was changed in a system that the user gave."""

    def run_of(self, method: str) -> IntegratorRun | None:
        """The first run of a method that reached its end, or None."""
        return next((run for run in self.runs if run.method == method and run.failure is None), None)

    def best(self) -> IntegratorRun | None:
        """The run with the smallest largest energy error, or at equal accuracy with the fewest force evaluations.

        None if all failed.
        """
        finished = [run for run in self.runs if run.failure is None]
        if self.wanted_error is not None:
            return min(finished, key=lambda run: run.force_evaluations, default=None)
        return min(finished, key=lambda run: run.largest_energy_error, default=None)

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

    def saving(self, run: IntegratorRun, reference: str = "control") -> float:
        """The force evaluations of fixed steps divided by those of a run: the gain at an equal energy error.

        Args:
            run: the run to judge.
            reference: ``control`` for RATTLE with fixed steps, ``fixed`` for OpenMM's VerletIntegrator.
        """
        other = self.run_of(reference)
        if other is None or run.failure is not None:
            return math.nan
        return other.force_evaluations / run.force_evaluations


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
    integrators: Iterable[str] | None = None,
    wanted_error: float | None = None,
) -> Comparison:
    """Run integrators on a system.

    An integrator that fails is listed with its message, and the others go on. An interrupt from the keyboard ends the
    comparison with what was done so far.

    Args:
        test_system: the system and its start.
        platform: name of the OpenMM platform, as for `openmmvrattle.platforms`.
        settings: what to run; by default the settings recommended for the system.
        progress: called while the runs go on.
        integrators: names out of `openmmvrattle.compare.measurement.INTEGRATORS`; by default those of
            `DEFAULT_INTEGRATORS` there.
        wanted_error: kJ/mol; if given, the number of force evaluations is searched that each integrator needs for it,
            instead of giving all of them the same number.
    """
    case = Case(test_system, settings or test_system.settings, platform, tuple(integrators or ()), wanted_error)
    runs: list[IntegratorRun] = []
    interrupted = False
    try:
        for index in range(len(case.methods())):
            runs.append(run_case(case, index, progress))
    except KeyboardInterrupt:
        interrupted = True
    return case.comparison(runs, interrupted)


@dataclass(frozen=True)
class Case:
    """What one comparison is about: a system from one start. It can be sent to other processes and machines."""

    test_system: TestSystem
    settings: ComparisonSettings
    platform: str = "Reference"
    integrators: tuple[str, ...] = ()
    """Names out of `openmmvrattle.compare.measurement.INTEGRATORS`; none for the default ones."""
    wanted_error: float | None = None
    """In kJ/mol; if given, compare at this accuracy instead of at equal force evaluations."""
    most_evaluations: int | None = None
    """The largest number of force evaluations that is tried for it."""
    label: str = ""
    """The name of its files; by default that of the system."""
    seed: int | None = None
    """Of the random start, if one was chosen."""

    def methods(self) -> list[Method]:
        """The integrators in the order in which they are shown."""
        return methods_of(self.settings, self.integrators or None)

    def comparison(self, runs: Sequence[IntegratorRun], interrupted: bool = False) -> Comparison:
        """Put finished runs together."""
        try:
            energy = initial_energy(self.test_system, self.platform)
        except Exception:  # the runs have failed for the same reason, and say so
            energy = math.nan
        return Comparison(
            system_name=self.test_system.name,
            description=self.test_system.description,
            platform=self.platform,
            total_time=self.settings.total_time,
            force_evaluations=self.settings.force_evaluations,
            constraint_tolerance=self.settings.constraint_tolerance,
            initial_energy=energy,
            runs=tuple(runs),
            interrupted=interrupted,
            label=self.label or self.test_system.name,
            seed=self.seed,
            wanted_error=self.wanted_error,
            notes=self.test_system.notes,
        )


def run_case(case: Case, index: int, progress: Progress | None = None) -> IntegratorRun:
    """Run one of the integrators of a case; whatever goes wrong is told in the run that is returned.

    Args:
        case: what to run.
        index: which of the methods of the case.
        progress: called while the run goes on.
    """
    method = case.methods()[index]
    common = (method, case.test_system, case.platform, case.settings)
    try:
        if case.wanted_error is None:
            run = run_method(*common, progress)
        else:
            run = run_to_accuracy(*common, case.wanted_error, case.most_evaluations, progress)
    except Exception as error:  # one integrator must not stop the others
        run = failed_run(method, " ".join(str(error).split()) or type(error).__name__)
    if progress is not None:
        progress(method.name, "done", 1.0)
    return run


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
        sentences.append("No integrator reached the end.")
    elif comparison.wanted_error is None:
        sentences.append(f"Smallest largest energy error: {best.name}, {two_digits(best.largest_energy_error)} kJ/mol.")
    else:
        sentences.append(
            f"Fewest force evaluations for an energy error of {two_digits(comparison.wanted_error)} kJ/mol: "
            f"{best.name}, {best.force_evaluations:,}."
        )
    for run in comparison.runs:
        if run.method == "vrattle" and run.failure is None:
            sentences.extend(_judgement(comparison, run))
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


def _judgement(comparison: Comparison, run: IntegratorRun) -> list[str]:
    """What a run with variable steps has gained over fixed steps; nothing if no fixed steps were run."""
    by_accuracy = comparison.wanted_error is not None
    measure = comparison.saving if by_accuracy else comparison.gain
    gains = {"RATTLE with fixed steps": measure(run, "control"), "VerletIntegrator": measure(run, "fixed")}
    known = {name: gain for name, gain in gains.items() if math.isfinite(gain)}
    if not known:
        if not any(other.method in ("control", "fixed") for other in comparison.runs):
            return []
        return [f"{run.name} reached the end, where no integrator with fixed steps did."]
    gain = next(iter(known.values()))
    if gain > 1.25:
        words = "Variable steps win"
    elif gain > 0.8:
        words = "No difference worth the name"
    else:
        words = "Fixed steps win"
    what = "force evaluations" if by_accuracy else "largest energy error"
    numbers = ", ".join(f"{two_digits(gain)} over {name}" for name, gain in known.items())
    return [f"{words}: the gain of {run.name} (their {what} divided by its own) is {numbers}."]


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
    row["evaluations_saved_over_fixed_rattle"] = comparison.saving(run, "control")
    return row


def write_summary(comparisons: Sequence[Comparison], path: Path) -> None:
    """Write one line for each run of each system to a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = None
        for comparison in comparisons:
            for run in comparison.runs:
                row = {
                    "system": comparison.system_name,
                    "seed": comparison.seed,
                    "wanted_error": comparison.wanted_error,
                    "evaluations_asked_for": comparison.force_evaluations,
                    "platform": comparison.platform,
                    **_summary_of(comparison, run),
                }
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
