# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Reports of runs with variable steps, in the style of ``openmm.app``.

- `StepSizeReporter` writes how the steps went: their size and density, the monitors, the error of the energy and of the
  constraints. It goes into ``Simulation.reporters`` like any other.
- `run_for_time` runs a Simulation for a time and lets all its reporters report at equal times, where
  ``Simulation.step`` knows only numbers of steps, which with variable steps are not equally long.

>>> from openmm import app, unit
>>> from openmmvrattle import VariableStepRattleIntegrator
>>> from openmmvrattle.reporters import StepSizeReporter, run_for_time
>>> from openmmvrattle.testsystems import double_pendulum
>>> pendulum = double_pendulum()
>>> simulation = app.Simulation(pendulum.topology, pendulum.system, VariableStepRattleIntegrator(0.001))
>>> simulation.context.setPositions(pendulum.positions)
>>> reporter = StepSizeReporter(None, 100)
>>> simulation.reporters.append(reporter)
>>> run_for_time(simulation, 0.1 * unit.picosecond, every=0.05)
>>> [row["Time (ps)"] for row in reporter.rows]
[0.05, 0.1]
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from os import PathLike
from typing import IO, Any

import openmm
from openmm import app, unit

from ._arguments import plain
from ._constraint_errors import ConstraintErrors, expressions_of
from .custom import CustomVariableStepRattleIntegrator
from .custom.settings import MONITOR_KINDS
from .serialization import with_class

__all__ = ["StepSizeReporter", "run_for_time"]


class StepSizeReporter:
    """Writes how the steps of a run went, as a table of comma-separated values or into memory.

    The columns are, as far as the integrator has them: step, time, size and density of the last step, the value of each
    monitor, energy minus the energy at the start, iterations of the constraint solver per step since the last report,
    rescues and force evaluations so far, and the largest relative error of a constraint, in the sense of
    setConstraintTolerance(). With automatic step control the monitors are U_A and U_B of docs/automatic_method.md, and
    at constant temperature there is one, U. An integrator of OpenMM has the step size alone of what is about steps, so
    the two can be compared.

    A report does not disturb the run, and costs no force evaluation of the integrator. For its energy it asks OpenMM
    for the potential energy, as ``StateDataReporter`` does; two reporters that report at the same step share it, and
    ``energyError=False`` does without.
    """

    def __init__(
        self,
        file: str | PathLike[str] | IO[str] | None,
        reportInterval: int,
        *,
        step: bool = True,
        time: bool = True,
        stepSize: bool = True,
        stepDensity: bool = True,
        monitors: bool = True,
        energyError: bool = True,
        solverIterations: bool = True,
        rescues: bool = True,
        forceEvaluations: bool = True,
        constraintError: bool = True,
        separator: str = ",",
        append: bool = False,
    ) -> None:
        """Create a StepSizeReporter.

        Args:
            file: the name of a file, a stream, or None to collect the rows in memory.
            reportInterval: the number of steps from one report to the next.
            step: whether to report the number of the step.
            time: whether to report the time.
            stepSize: whether to report the size of the last step.
            stepDensity: whether to report the density of the last step, the nominal step size divided by its size.
            monitors: whether to report the monitors.
            energyError: whether to report the energy minus that at the start.
            solverIterations: whether to report the iterations of the constraint solver per step.
            rescues: whether to report the number of rescued steps.
            forceEvaluations: whether to report the number of force evaluations.
            constraintError: whether to report the largest relative error of a constraint: of a distance, or of an
                expression of up to 100 particles.
            separator: what stands between two columns.
            append: whether to add to an existing file, without a line of headings.
        """
        if reportInterval != int(reportInterval) or reportInterval < 1:
            raise ValueError(f"The report interval is a number of steps, at least 1, and not {reportInterval}.")
        self.rows: list[dict[str, float]] = []
        """The reports so far, values by heading; empty if they go to a file or a stream."""
        self._interval = int(reportInterval)
        self._wanted = {
            "Step": step,
            "Time (ps)": time,
            "Step Size (ps)": stepSize,
            "Step Density": stepDensity,
            "Monitors": monitors,
            "Energy Error (kJ/mole)": energyError,
            "Solver Iterations per Step": solverIterations,
            "Rescues": rescues,
            "Force Evaluations": forceEvaluations,
            "Constraint Error": constraintError,
        }
        self._separator = separator
        self._append = append
        self._in_memory = file is None
        self._path = file if isinstance(file, (str, PathLike)) else None
        self._stream: IO[str] | None = None
        if self._path is not None:
            self._stream = open(self._path, "a" if append else "w", encoding="utf-8", newline="")
        elif file is not None:
            self._stream = file
        self._headings: list[str] = []
        self._energy_at_start: float | None = None
        self._last_count: tuple[int, int] | None = None
        self._constraint_errors: ConstraintErrors | None = None

    def describeNextReport(self, simulation: app.Simulation) -> dict[str, Any]:
        """Get information about the next report.

        Args:
            simulation: the Simulation that is to be reported.

        Returns:
            The steps until the report and what it needs, as OpenMM asks for.
        """
        self._begin(simulation)
        include = []
        if self._wanted["Energy Error (kJ/mole)"]:
            include.append("energy")
        if self._wanted["Constraint Error"]:
            include.append("positions")
        steps = self._interval - simulation.currentStep % self._interval
        return {"steps": steps, "periodic": None, "include": include}

    def _begin(self, simulation: app.Simulation) -> None:
        """Take down where the run starts."""
        integrator = _integrator_of(simulation)
        if self._last_count is None:
            self._last_count = (simulation.currentStep, _called(integrator, "getNumSolverIterations") or 0)
        if self._energy_at_start is None and self._wanted["Energy Error (kJ/mole)"]:
            groups = simulation.context.getIntegrator().getIntegrationForceGroups()
            self._energy_at_start = _energy(simulation.context.getState(energy=True, groups=groups))

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write a report.

        Args:
            simulation: the Simulation that is to be reported.
            state: its state, with what `describeNextReport` has asked for.
        """
        self._begin(simulation)
        row = self._row(simulation, state)
        if not self._headings:
            self._headings = list(row)
            if self._stream is not None and not self._append:
                # As in the files of StateDataReporter.
                print("#" + self._separator.join(f'"{heading}"' for heading in row), file=self._stream)
        if self._in_memory:
            self.rows.append(row)
        if self._stream is not None:
            # repr of a float is the shortest text that reads as the same number.
            values = (row.get(heading, math.nan) for heading in self._headings)
            print(self._separator.join(repr(value) for value in values), file=self._stream)
            if hasattr(self._stream, "flush"):
                self._stream.flush()

    def _row(self, simulation: app.Simulation, state: openmm.State) -> dict[str, float]:
        """The values of one report by heading; what the integrator does not have is left out."""
        integrator = _integrator_of(simulation)
        step, time = int(simulation.currentStep), plain(state.getTime(), unit.picosecond)
        row: dict[str, float | None] = {
            "Step": step,
            "Time (ps)": time,
            "Step Size (ps)": _called(integrator, "getStepSize"),
            "Step Density": _called(integrator, "getStepDensity"),
        }
        if self._wanted["Monitors"]:
            row |= _monitor_values(integrator)
        if self._wanted["Energy Error (kJ/mole)"]:
            assert self._energy_at_start is not None
            row["Energy Error (kJ/mole)"] = _energy(state) - self._energy_at_start
        row["Solver Iterations per Step"] = self._iterations_per_step(integrator, step)
        row["Rescues"] = _called(integrator, "getNumRescues")
        row["Force Evaluations"] = _called(integrator, "getNumForceEvaluations")
        if self._wanted["Constraint Error"]:
            row["Constraint Error"] = self._constraint_error(simulation.system, integrator, state)
        return {
            heading: value for heading, value in row.items() if value is not None and self._wanted.get(heading, True)
        }

    def _iterations_per_step(self, integrator: Any, step: int) -> float | None:
        iterations = _called(integrator, "getNumSolverIterations")
        if iterations is None:
            return None
        assert self._last_count is not None
        last_step, last_iterations = self._last_count
        self._last_count = (step, iterations)
        return (iterations - last_iterations) / (step - last_step) if step > last_step else math.nan

    def _constraint_error(self, system: openmm.System, integrator: Any, state: openmm.State) -> float:
        if self._constraint_errors is None:
            self._constraint_errors = ConstraintErrors(system)
        self._constraint_errors.update(expressions_of(integrator))
        return self._constraint_errors.largest(plain(state.getPositions(asNumpy=True), unit.nanometer))

    def to_dataframe(self) -> Any:
        """Get the reports so far as a pandas DataFrame, from memory or from the file.

        Returns:
            A DataFrame with one row for each report. It needs the package pandas.
        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError("A DataFrame needs the package pandas: pip install pandas.") from error
        if self._in_memory:
            return pandas.DataFrame(self.rows)
        if self._path is None:
            raise ValueError(
                "What was written to a stream cannot be read back: create the reporter with None or a file."
            )
        frame = pandas.read_csv(self._path, sep=self._separator, quoting=csv.QUOTE_NONE, engine="python")
        return frame.rename(columns=lambda heading: heading.lstrip("#").strip('"'))

    def __del__(self) -> None:
        if getattr(self, "_path", None) is not None and self._stream is not None:
            self._stream.close()


def run_for_time(
    simulation: app.Simulation, duration: float | unit.Quantity, every: float | unit.Quantity | None = None
) -> None:
    """Run a Simulation for a time and let all its reporters report at equal times.

    The time is met exactly at each report, and the last report is at the end. The report intervals of the reporters,
    which are numbers of steps, are not used. With an integrator that chooses its steps this shortens the step before
    each report (see ``stepTo``), so let many steps lie between two reports. With fixed steps the times must be
    multiples of the step. Of a CompoundIntegrator it is the integrator chosen at the time that counts.

    The files of ``DCDReporter`` and ``XTCReporter`` get the times of the reports, if they were begun here.

    Args:
        simulation: the Simulation to run.
        duration: the time to run for, ps or a Quantity.
        every: the time from one report to the next, ps or a Quantity; by default there is one report, at the end.
    """
    length = _positive(duration, "duration")
    interval = length if every is None else min(_positive(every, "time between reports"), length)
    context = simulation.context
    start = plain(context.getTime(), unit.picosecond)
    # A last interval that is short by nothing but rounding is a whole one.
    count = max(1, math.ceil(length / interval * (1.0 - 1e-9)))
    integrator = _integrator_of(simulation)
    if not hasattr(integrator, "stepTo"):
        for time in {interval, length - (count - 1) * interval}:
            _whole_steps(integrator, time)
    for number in range(1, count + 1):
        # Not a sum of intervals, so that roundings do not add up.
        # As in Simulation.step, reporters say what they need before the steps.
        wishes = [(reporter, *_wish(reporter.describeNextReport(simulation))) for reporter in simulation.reporters]
        _advance(simulation, start + length if number == count else start + number * interval)
        _report(simulation, interval, wishes)


def _advance(simulation: app.Simulation, time: float) -> None:
    integrator = _integrator_of(simulation)  # a reporter may have chosen another one
    if hasattr(integrator, "stepTo"):
        _advance_by_time(integrator, simulation.context, time)
    else:
        _advance_by_steps(integrator, simulation.context, time)


def _advance_by_time(integrator: Any, context: openmm.Context, time: float) -> None:
    largest = _called(integrator, "getMaximumStepSize")
    if largest:
        # A few steps at a time as far as they cannot lead beyond, to give Python a chance to respond to Ctrl-C.
        last = -math.inf
        while time - (now := plain(context.getTime(), unit.picosecond)) > 30.0 * largest and now > last:
            last = now  # at times so large that steps are lost in their rounding stepTo says so
            integrator.step(10)
    integrator.stepTo(time)


def _advance_by_steps(integrator: Any, context: openmm.Context, time: float) -> None:
    now = plain(context.getTime(), unit.picosecond)
    steps = _whole_steps(integrator, time - now)
    while steps > 0:
        integrator.step(min(10, steps))
        steps -= 10
    reached = plain(context.getTime(), unit.picosecond)
    if abs(reached - time) > 1e-6 * (time - now):
        name = type(integrator).__name__
        raise ValueError(f"{name} has no stepTo and does not take fixed steps, so it cannot be run until a given time.")


def _whole_steps(integrator: Any, time: float) -> int:
    """The number of fixed steps in a time."""
    size = plain(integrator.getStepSize(), unit.picosecond)
    steps = round(time / size) if size > 0.0 else 0
    if steps < 1 or abs(steps * size - time) > 1e-6 * size * max(1, steps):
        raise ValueError(
            f"{time:g} ps is not a multiple of the step of {size:g} ps of {type(integrator).__name__}: "
            "choose the duration and the time between reports as multiples of the step."
        )
    return steps


def _report(simulation: app.Simulation, interval: float, wishes: list[tuple[Any, bool | None, set[str]]]) -> None:
    """Let all reporters report, with as few States as their wishes allow."""
    uses_box = simulation.system.usesPeriodicBoundaryConditions()
    groups: dict[bool, list[tuple[Any, set[str]]]] = {True: [], False: []}
    indifferent = []
    for reporter, periodic, include in wishes:
        if "positions" in include:
            groups[uses_box if periodic is None else bool(periodic)].append((reporter, include))
        else:
            indifferent.append((reporter, include))
    groups[len(groups[True]) > len(groups[False])] += indifferent
    force_groups = simulation.context.getIntegrator().getIntegrationForceGroups()
    for periodic, members in groups.items():
        if members:
            include = dict.fromkeys(set().union(*(wanted for _, wanted in members)), True)
            state = simulation.context.getState(
                groups=force_groups, enforcePeriodicBox=periodic, parameters=True, **include
            )
            for reporter, _ in members:
                reporter.report(_as_seen_by(reporter, simulation, interval), state)


def _wish(description: dict[str, Any] | Sequence[Any]) -> tuple[bool | None, set[str]]:
    """Whether positions are to be in the periodic box, and what a report needs, from a dict or from the old tuple."""
    if isinstance(description, dict):
        return description.get("periodic"), set(description.get("include", ()))
    names = ("positions", "velocities", "forces", "energy")
    include = {name for name, wanted in zip(names, description[1:5], strict=True) if wanted}
    return (description[5] if len(description) > 5 else None), include


def _as_seen_by(reporter: Any, simulation: app.Simulation, interval: float) -> Any:
    """The Simulation; for reporters whose files count time in steps, one whose steps are those between reports."""
    if isinstance(reporter, (app.DCDReporter, app.XTCReporter)):
        return _WithStepSize(simulation, interval / reporter._reportInterval)
    return simulation


class _WithStepSize:
    """A Simulation whose integrator states a given step size."""

    def __init__(self, simulation: app.Simulation, size: float) -> None:
        self._simulation = simulation
        self._size = size

    @property
    def integrator(self) -> _WithStepSize:
        return self

    def getStepSize(self) -> unit.Quantity:
        return self._size * unit.picosecond

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulation, name)


def _integrator_of(simulation: app.Simulation) -> Any:
    """The integrator that takes the steps, of its own class: of a CompoundIntegrator the one that is chosen."""
    integrator = simulation.integrator
    if isinstance(integrator, openmm.CompoundIntegrator):
        integrator = integrator.getIntegrator(integrator.getCurrentIntegrator())
    found = type(integrator)
    integrator = with_class(integrator)  # OpenMM does not know the class of what it returns, or reads from XML
    if isinstance(integrator, CustomVariableStepRattleIntegrator) and type(integrator) is not found:
        integrator.attachContext(simulation.context)
    return integrator


def _monitor_values(integrator: Any) -> dict[str, float | None]:
    if not hasattr(integrator, "getMonitorValue"):
        return {}
    if hasattr(integrator, "isAutomatic") and integrator.isAutomatic():
        # Its two monitors are its own.
        return {f"Monitor {name}": float(integrator.getMonitorValue(k)) for k, name in enumerate(("U_A", "U_B"))}
    if not hasattr(integrator, "getNumMonitors"):  # at constant temperature there is one, U
        return {"Monitor U": float(integrator.getMonitorValue())}
    values: dict[str, float | None] = {}
    for index in range(integrator.getNumMonitors()):
        kind = integrator.getMonitor(index)[0]
        name = f"Monitor {MONITOR_KINDS[kind]}"
        while name in values:
            name += " again"
        values[name] = float(integrator.getMonitorValue(index))
    return values


def _called(integrator: Any, name: str) -> Any:
    """What a method gives, as a plain number; None if the integrator does not have it."""
    method = getattr(integrator, name, None)
    if method is None:
        return None
    value = method()
    return value.value_in_unit(unit.picosecond) if unit.is_quantity(value) else value


def _energy(state: openmm.State) -> float:
    return plain(state.getKineticEnergy() + state.getPotentialEnergy(), unit.kilojoule_per_mole)


def _positive(time: float | unit.Quantity, what: str) -> float:
    value = float(plain(time, unit.picosecond))
    if not 0.0 < value < math.inf:
        raise ValueError(f"The {what} must be a positive time, and not {value:g} ps.")
    return value
