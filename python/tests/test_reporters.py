# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""StepSizeReporter and run_for_time."""

from __future__ import annotations

import csv
import io
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmmvrattle import (
    CustomVariableStepRattleIntegrator,
    VariableStepRattleIntegrator,
    VariableStepRattleLangevinIntegrator,
)
from openmmvrattle.platforms import platform_and_properties
from openmmvrattle.reporters import StepSizeReporter, run_for_time
from openmmvrattle.testsystems import constraint_error, light_heavy_chain, rigid_waters
from run_support import GPU, needs_gpu

HEADINGS = [
    "Step",
    "Time (ps)",
    "Step Size (ps)",
    "Step Density",
    "Monitor ConstraintForce",
    "Monitor ForcePNorm",
    "Energy Error (kJ/mole)",
    "Solver Iterations per Step",
    "Rescues",
    "Force Evaluations",
    "Constraint Error",
]


def our_integrator(step: float = 0.001) -> VariableStepRattleIntegrator:
    integrator = VariableStepRattleIntegrator(step)
    integrator.clearMonitors()
    integrator.addMonitor(VariableStepRattleIntegrator.ConstraintForce)
    integrator.addMonitor(VariableStepRattleIntegrator.ForcePNorm, 1.0, 0.5)
    return integrator


def make_simulation(integrator: openmm.Integrator | None = None, system: openmm.System | None = None) -> app.Simulation:
    waters = rigid_waters(4)
    simulation = app.Simulation(
        waters.topology,
        system or waters.system,
        integrator or our_integrator(),
        openmm.Platform.getPlatformByName("Reference"),
    )
    simulation.context.setPositions(waters.positions)
    simulation.context.setVelocities(waters.velocities)
    return simulation


def energy_of(simulation: app.Simulation) -> float:
    state = simulation.context.getState(energy=True)
    return (state.getKineticEnergy() + state.getPotentialEnergy()).value_in_unit(unit.kilojoule_per_mole)


def arrays(simulation: app.Simulation) -> tuple[np.ndarray, np.ndarray]:
    state = simulation.context.getState(positions=True, velocities=True)
    return state.getPositions(asNumpy=True)._value, state.getVelocities(asNumpy=True)._value


def time_of(simulation: app.Simulation) -> float:
    return simulation.context.getTime().value_in_unit(unit.picosecond)


def read(text: str) -> list[dict[str, float]]:
    rows = list(csv.reader(io.StringIO(text)))
    headings = [heading.strip('#"') for heading in rows[0]]
    return [dict(zip(headings, map(float, row), strict=True)) for row in rows[1:]]


def test_every_column_is_what_the_integrator_and_the_state_say() -> None:
    simulation = make_simulation()
    integrator = simulation.integrator
    start = energy_of(simulation)
    output = io.StringIO()
    simulation.reporters.append(StepSizeReporter(output, 5))
    iterations = 0
    for number in range(1, 4):
        simulation.step(5)
        row = read(output.getvalue())[-1]
        assert list(row) == HEADINGS
        assert row["Step"] == 5 * number
        assert row["Time (ps)"] == time_of(simulation)
        assert row["Step Size (ps)"] == integrator.getStepSize().value_in_unit(unit.picosecond)
        assert row["Step Density"] == integrator.getStepDensity() == pytest.approx(0.001 / row["Step Size (ps)"])
        assert row["Monitor ConstraintForce"] == integrator.getMonitorValue(0)
        assert row["Monitor ForcePNorm"] == integrator.getMonitorValue(1)
        assert row["Energy Error (kJ/mole)"] == pytest.approx(energy_of(simulation) - start, abs=1e-10)
        assert row["Energy Error (kJ/mole)"] != 0.0
        per_step = (integrator.getNumSolverIterations() - iterations) / 5
        assert row["Solver Iterations per Step"] == per_step > 0 or number == 1
        iterations = integrator.getNumSolverIterations()
        assert row["Rescues"] == integrator.getNumRescues() == 0
        assert row["Force Evaluations"] == integrator.getNumForceEvaluations()
        error = constraint_error(simulation.system, arrays(simulation)[0])
        assert row["Constraint Error"] == pytest.approx(error, abs=1e-13)
        assert 0 < error < 1e-7
    assert len(read(output.getvalue())) == 3


@needs_gpu
def test_reports_on_a_device() -> None:
    """On a platform by name: the columns are those of Reference, at the same times and at equal ones."""
    rows = {}
    for name in ("Reference", f"{GPU}:double"):
        waters, output = rigid_waters(4), io.StringIO()
        simulation = app.Simulation(waters.topology, waters.system, our_integrator(), *platform_and_properties(name))
        simulation.context.setPositions(waters.positions)
        simulation.context.setVelocities(waters.velocities)
        simulation.reporters.append(StepSizeReporter(output, 5))
        simulation.step(10)
        run_for_time(simulation, 0.02, every=0.01)
        rows[name] = read(output.getvalue())
        assert simulation.integrator.isOnDevice() == (name != "Reference")
    expected, found = rows.values()
    assert len(expected) == len(found) == 4
    for one, other in zip(expected, found, strict=True):
        assert list(other) == HEADINGS
        assert other["Constraint Error"] < 1e-8
        others = ("Constraint Error", "Solver Iterations per Step", "Energy Error (kJ/mole)")
        same = [name for name in HEADINGS if name not in others]
        # The forces of the two platforms differ by less than 1e-5, and their energies by a constant.
        assert [other[name] for name in same] == pytest.approx([one[name] for name in same], rel=1e-3)
        assert other["Energy Error (kJ/mole)"] == pytest.approx(one["Energy Error (kJ/mole)"], abs=2e-3)


def test_a_report_does_not_disturb_the_run() -> None:
    """To the last bit, and the integrator computes the forces as often."""
    ends = []
    for report in (False, True):
        simulation = make_simulation()
        if report:
            simulation.reporters.append(StepSizeReporter(None, 1))
        simulation.step(50)
        ends.append((*arrays(simulation), simulation.integrator.getNumForceEvaluations()))
    for without, with_reports in zip(*ends, strict=True):
        assert np.array_equal(without, with_reports)


def test_no_force_is_computed_for_a_report() -> None:
    """Counted by a force of Python's own: without the energy none at all, with it one computation for each report."""
    counts = []
    for reporters in ([], [StepSizeReporter(None, 1, energyError=False)], [StepSizeReporter(None, 2)]):
        calls = 0

        def harmonic(state: openmm.State) -> tuple[float, np.ndarray]:
            nonlocal calls
            calls += 1
            x = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
            return 50.0 * float(np.sum(x**2)), -100.0 * x

        system = rigid_waters(4).system
        system.addForce(openmm.PythonForce(harmonic))
        simulation = make_simulation(system=system)
        simulation.reporters += reporters
        simulation.step(20)
        counts.append(calls)
    assert counts[0] >= 20
    assert counts[1] == counts[0]
    assert counts[2] == counts[0] + 10 + 1  # and once at the start


def test_files_are_flushed_and_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "steps.csv"
    simulation = make_simulation()
    simulation.reporters.append(StepSizeReporter(path, 2, separator=";"))
    simulation.step(4)
    lines = path.read_text().splitlines()  # the file is still open
    assert len(lines) == 3
    assert lines[0].startswith('#"Step";"Time (ps)"')
    simulation.reporters[0] = StepSizeReporter(str(path), 2, separator=";", append=True)
    simulation.step(4)
    lines = path.read_text().splitlines()
    assert len(lines) == 5
    assert [line.split(";")[0] for line in lines[1:]] == ["2", "4", "6", "8"]


def test_columns_can_be_left_out() -> None:
    output = io.StringIO()
    simulation = make_simulation()
    others = {
        name: False
        for name in (
            *("step", "stepDensity", "monitors", "energyError", "solverIterations"),
            *("rescues", "forceEvaluations", "constraintError"),
        )
    }
    reporter = StepSizeReporter(output, 5, **others)
    simulation.reporters.append(reporter)
    assert reporter.describeNextReport(simulation) == {"steps": 5, "periodic": None, "include": []}
    simulation.step(5)
    assert list(read(output.getvalue())[0]) == ["Time (ps)", "Step Size (ps)"]


def test_dataframe_from_memory_and_from_a_file(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    simulation = make_simulation()
    reporters = [StepSizeReporter(None, 3), StepSizeReporter(tmp_path / "steps.csv", 3)]
    simulation.reporters += reporters
    simulation.step(9)
    frames = [reporter.to_dataframe() for reporter in reporters]
    for frame in frames:
        assert list(frame.columns) == HEADINGS
        assert frame["Step"].tolist() == [3, 6, 9]
    # The shortest text that reads as the same number is written, so nothing is lost.
    assert np.array_equal(frames[0].to_numpy(), frames[1].to_numpy())


def test_dataframe_that_cannot_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ImportError, match="pip install pandas"):
        monkeypatch.setitem(sys.modules, "pandas", None)
        StepSizeReporter(None, 1).to_dataframe()
    monkeypatch.undo()
    pytest.importorskip("pandas")
    with pytest.raises(ValueError, match="stream"):
        StepSizeReporter(io.StringIO(), 1).to_dataframe()


@pytest.mark.parametrize("interval", [0, -1, 2.5])
def test_interval_that_is_none(interval: float) -> None:
    with pytest.raises(ValueError, match="report interval"):
        StepSizeReporter(None, interval)  # type: ignore[arg-type]


def test_integrators_of_openmm_have_fewer_columns() -> None:
    simulation = make_simulation(openmm.VerletIntegrator(0.001))
    reporter = StepSizeReporter(None, 4)
    simulation.reporters.append(reporter)
    simulation.step(8)
    assert len(reporter.rows) == 2
    assert list(reporter.rows[0]) == [
        "Step",
        "Time (ps)",
        "Step Size (ps)",
        "Energy Error (kJ/mole)",
        "Constraint Error",
    ]
    assert reporter.rows[0]["Step Size (ps)"] == 0.001


def test_the_custom_integrator_has_all_columns() -> None:
    integrator = CustomVariableStepRattleIntegrator(0.001)
    simulation = make_simulation(integrator)
    reporter = StepSizeReporter(None, 4)
    simulation.reporters.append(reporter)
    simulation.step(8)
    assert set(reporter.rows[0]) == set(HEADINGS) - {"Monitor ForcePNorm"}
    run_for_time(simulation, 0.02, every=0.01)
    assert reporter.rows[-1]["Time (ps)"] - reporter.rows[-2]["Time (ps)"] == pytest.approx(0.01, rel=1e-9)


def test_integrator_inside_a_compound_one() -> None:
    compound = openmm.CompoundIntegrator()
    compound.addIntegrator(openmm.VerletIntegrator(0.001))
    compound.addIntegrator(our_integrator())
    compound.setCurrentIntegrator(1)
    simulation = make_simulation(compound)
    reporter = StepSizeReporter(None, 4)
    simulation.reporters.append(reporter)
    simulation.step(4)
    assert list(reporter.rows[0]) == HEADINGS


def test_energy_error_is_that_of_a_difficult_moment() -> None:
    """On the whip the steps shrink and the monitor rises where it straightens; the report shows both."""
    chain = light_heavy_chain()
    integrator = VariableStepRattleIntegrator(0.00125)
    integrator.setMinimumStepSize(1.25e-5)
    integrator.setMaximumStepSize(0.0125)
    simulation = app.Simulation(
        chain.topology, chain.system, integrator, openmm.Platform.getPlatformByName("Reference")
    )
    simulation.context.setPositions(chain.positions)
    simulation.context.setVelocities(chain.velocities)
    reporter = StepSizeReporter(None, 1)
    simulation.reporters.append(reporter)
    simulation.step(3000)
    sizes = np.array([row["Step Size (ps)"] for row in reporter.rows])
    monitor = np.array([row["Monitor ConstraintMultipliers"] for row in reporter.rows])
    assert sizes.max() / sizes.min() > 20
    assert np.corrcoef(np.log(sizes), np.log(monitor))[0, 1] < -0.9


# --------------------------------------------------------------------------------------------------- equal times


class TupleReporter:
    """A reporter with the old form of describeNextReport."""

    def __init__(self, *wishes: Any) -> None:
        self._wishes = wishes
        self.times: list[float] = []
        self.states: list[openmm.State] = []

    def describeNextReport(self, simulation: app.Simulation) -> tuple[Any, ...]:
        return (1000, *self._wishes)

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        self.times.append(state.getTime().value_in_unit(unit.picosecond))
        self.states.append(state)


@pytest.mark.parametrize("integrator", ["ours", "VariableVerlet", "Verlet"])
def test_reports_are_at_equal_times(integrator: str) -> None:
    made = {
        "ours": our_integrator,
        "VariableVerlet": lambda: openmm.VariableVerletIntegrator(1e-4),
        "Verlet": lambda: openmm.VerletIntegrator(0.001),
    }[integrator]()
    simulation = make_simulation(made)
    output = io.StringIO()
    reporter = TupleReporter(True, False, False, True)
    simulation.reporters += [app.StateDataReporter(output, 7, step=True, time=True, totalEnergy=True), reporter]
    run_for_time(simulation, 60 * unit.femtosecond, every=0.012)
    expected = [0.012, 0.024, 0.036, 0.048, 0.06]
    assert reporter.times == pytest.approx(expected, rel=1e-12)
    if integrator == "ours":
        assert reporter.times == [0.012, 0.024, 3 * 0.012, 0.048, 0.06]
        assert time_of(simulation) == 0.06
    rows = read(output.getvalue())
    assert [row["Time (ps)"] for row in rows] == reporter.times
    energies = [
        (s.getKineticEnergy() + s.getPotentialEnergy()).value_in_unit(unit.kilojoule_per_mole) for s in reporter.states
    ]
    assert [row["Total Energy (kJ/mole)"] for row in rows] == pytest.approx(energies, rel=1e-12)
    assert rows[-1]["Step"] == simulation.currentStep


def test_the_last_report_is_at_the_end() -> None:
    simulation = make_simulation()
    reporter = TupleReporter(False, False, False, False)
    simulation.reporters.append(reporter)
    run_for_time(simulation, 0.025, every=0.01)
    assert reporter.times == [0.01, 0.02, 0.025]
    run_for_time(simulation, 0.015)
    assert reporter.times[3:] == [0.025 + 0.015]
    run_for_time(simulation, 0.01, every=5)
    assert reporter.times[4:] == [0.04 + 0.01]
    # 0.1 / 0.01 and 0.3 / 0.1 are a little less or more than whole numbers.
    del reporter.times[:]
    run_for_time(simulation, 0.03, every=0.01)
    assert len(reporter.times) == 3


def test_without_reporters_it_is_stepTo() -> None:
    runs = []
    for way in ("stepTo", "run_for_time"):
        simulation = make_simulation()
        if way == "stepTo":
            simulation.integrator.stepTo(0.2)
        else:
            run_for_time(simulation, 0.2)
        runs.append((*arrays(simulation), time_of(simulation), simulation.currentStep))
    for one, other in zip(*runs, strict=True):
        assert np.array_equal(one, other)


def test_fixed_steps_are_those_of_step() -> None:
    one, other = make_simulation(openmm.VerletIntegrator(0.001)), make_simulation(openmm.VerletIntegrator(0.001))
    one.step(34)
    run_for_time(other, 0.034, every=0.017)
    assert other.currentStep == 34
    assert np.array_equal(arrays(one)[0], arrays(other)[0])


def test_trajectory_files_have_the_times(tmp_path: Path) -> None:
    simulation = make_simulation()
    simulation.reporters += [
        app.XTCReporter(str(tmp_path / "run.xtc"), 10, enforcePeriodicBox=False),
        app.DCDReporter(str(tmp_path / "run.dcd"), 10, enforcePeriodicBox=False),
    ]
    run_for_time(simulation, 0.1, every=0.02)
    expected = arrays(simulation)[0]
    simulation.reporters.clear()
    from openmm.app.internal.xtc_utils import read_xtc

    coordinates, _, times, _ = read_xtc(str(tmp_path / "run.xtc").encode())
    assert list(times) == pytest.approx([0.02, 0.04, 0.06, 0.08, 0.1], rel=1e-6)
    np.testing.assert_allclose(coordinates[:, :, -1], expected, rtol=0, atol=0.6e-3)
    dcd = (tmp_path / "run.dcd").read_bytes()
    interval = int(np.frombuffer(dcd, "<i4", 1, offset=16)[0])
    step = float(np.frombuffer(dcd, "<f4", 1, offset=44)[0]) * 0.04888821  # AKMA units
    assert interval * step == pytest.approx(0.02, rel=1e-5)


def test_step_size_reporter_at_equal_times() -> None:
    simulation = make_simulation()
    reporter = StepSizeReporter(None, 1)
    simulation.reporters.append(reporter)
    run_for_time(simulation, 0.05, every=0.01)
    assert [row["Time (ps)"] for row in reporter.rows] == [0.01, 0.02, 3 * 0.01, 0.04, 0.05]
    assert all(math.isfinite(value) for row in reporter.rows for value in row.values())


def test_positions_are_wrapped_for_those_who_want_it() -> None:
    """Each reporter gets positions as it asks for them: in the box, or as they are."""
    box = app.PDBFile(str(Path(app.__file__).parent / "data" / "tip3p.pdb"))
    system = app.ForceField("tip3p.xml").createSystem(
        box.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.6, constraints=app.HBonds
    )
    simulation = app.Simulation(
        box.topology, system, VariableStepRattleIntegrator(0.0005), openmm.Platform.getPlatformByName("Reference")
    )
    shift = np.array([20.0, 0.0, 0.0])
    simulation.context.setPositions(box.getPositions(asNumpy=True).value_in_unit(unit.nanometer) + shift)
    wishes = {"wrapped": (True,), "unwrapped": (False,), "as the system": (None,)}
    reporters = {name: TupleReporter(True, False, False, False, *wish) for name, wish in wishes.items()}
    simulation.reporters += reporters.values()
    run_for_time(simulation, 0.001)
    largest = {
        name: float(np.max(reporter.states[0].getPositions(asNumpy=True)._value[:, 0]))
        for name, reporter in reporters.items()
    }
    assert largest["unwrapped"] > 20
    assert largest["wrapped"] == largest["as the system"] < 4


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.0105,), "not a multiple of the step of 0.001 ps of VerletIntegrator"),
        ((0.01, 0.0025), "not a multiple"),
        ((0.0,), "duration must be a positive time"),
        ((math.nan,), "duration must be a positive time"),
        ((0.01, -1.0), "time between reports must be a positive time"),
    ],
)
def test_times_that_cannot_be(arguments: tuple[float, ...], words: str) -> None:
    simulation = make_simulation(openmm.VerletIntegrator(0.001))
    with pytest.raises(ValueError, match=words):
        run_for_time(simulation, *arguments)
    assert simulation.currentStep == 0


class OtherSteps(openmm.VerletIntegrator):
    """Steps are not what it says that they are."""

    def getStepSize(self) -> unit.Quantity:
        return 0.5 * super().getStepSize()


def test_variable_steps_without_stepTo_are_refused() -> None:
    simulation = make_simulation(OtherSteps(0.001))
    with pytest.raises(ValueError, match="OtherSteps has no stepTo and does not take fixed steps"):
        run_for_time(simulation, 0.01)


@pytest.mark.parametrize(
    "kind, automatic",
    [
        (VariableStepRattleIntegrator, False),
        (VariableStepRattleIntegrator, True),
        (CustomVariableStepRattleIntegrator, False),
    ],
)
def test_a_compound_integrator_is_run_for_a_time(kind: type, automatic: bool) -> None:
    """Equilibration with one integrator and the run with ours, as one Simulation, with reports at equal times."""
    test, ours = rigid_waters(4), kind(0.001, monitors=[kind.ConstraintAndAppliedForce])
    if automatic:
        ours.useAutomaticStepControl(20)
    thermostat = openmm.LangevinMiddleIntegrator(300, 1, 0.001)
    thermostat.setRandomNumberSeed(1)
    compound = openmm.CompoundIntegrator()
    for member in (thermostat, ours):
        compound.addIntegrator(member)
    simulation = make_simulation(compound, test.system)
    table = io.StringIO()
    simulation.reporters.append(app.StateDataReporter(table, 1, step=True, time=True, totalEnergy=True))
    simulation.reporters.append(reporter := StepSizeReporter(None, 1))
    run_for_time(simulation, 0.02, every=0.01)
    compound.setCurrentIntegrator(1)
    run_for_time(simulation, 0.02, every=0.01)
    times = [row["Time (ps)"] for row in read(table.getvalue())]
    assert times == pytest.approx([0.01, 0.02, 0.03, 0.04], rel=1e-12)
    assert times[2:] == [times[1] + 0.01, times[1] + 0.02]
    assert time_of(simulation) == times[-1]
    assert "Step Density" not in reporter.rows[1] and (reporter.rows[3]["Step Density"] != 1) != automatic
    monitors = [name for name in reporter.rows[3] if name.startswith("Monitor")]
    assert monitors == (["Monitor U_A", "Monitor U_B"] if automatic else ["Monitor ConstraintAndAppliedForce"])
    assert simulation.currentStep > 35


def test_monitors_of_automatic_step_control() -> None:
    integrator = VariableStepRattleIntegrator(0.001, automatic=True)
    simulation = make_simulation(integrator)
    reporter = StepSizeReporter(None, 5)
    simulation.reporters.append(reporter)
    simulation.step(10)
    for k, name in enumerate(("Monitor U_A", "Monitor U_B")):
        assert reporter.rows[-1][name] == integrator.getMonitorValue(k) > 0
        assert reporter.rows[-1][name] != reporter.rows[0][name]


def test_the_constraint_error_is_that_of_expressions_too() -> None:
    """Against formulas: a ring of a fixed radius, a plane through a point, and a distance of the System."""
    system = openmm.System()
    for mass in (1.0, 2.0, 0.0):
        system.addParticle(mass)
    system.addConstraint(0, 1, 0.2)
    integrator = VariableStepRattleIntegrator(0.001, monitors=[])
    integrator.addConstraint("k*(x1^2 + y1^2 - r^2)", [0], {"r": 0.5, "k": 1e3})
    integrator.addConstraint("(z1 - z2)/0.01", [1, 2])
    topology = app.Topology()
    residue = topology.addResidue("X", topology.addChain())
    for _ in range(3):
        topology.addAtom("X", None, residue)
    simulation = app.Simulation(topology, system, integrator, openmm.Platform.getPlatform("Reference"))
    exact = np.array([[0.5, 0.0, 0.0], [0.7, 0.0, 0.0], [0.0, 0.0, 0.0]])
    simulation.context.setPositions(exact)

    def reported(positions: np.ndarray) -> float:
        reporter = StepSizeReporter(None, 1, energyError=False, monitors=False)
        simulation.context.setPositions(positions)
        reporter.report(simulation, simulation.context.getState(positions=True))
        return reporter.rows[0]["Constraint Error"]

    def moved(particle: int, axis: int, by: float) -> np.ndarray:
        positions = exact.copy()
        positions[particle, axis] += by
        return positions

    assert reported(exact) < 1e-15
    # |g|/|grad g| over 0.1 nm: the gradient of the circle is 2 k r, that of the plane 1/0.01 (particle 2 is fixed).
    both = exact + [[0.0, 0.01, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.0]]
    assert reported(both) == pytest.approx(0.01**2 / (2 * math.hypot(0.5, 0.01)) / 0.1, rel=1e-9)
    assert reported(moved(1, 2, 0.003)) == pytest.approx(0.03, rel=1e-9)
    assert reported(moved(1, 0, 0.004)) == pytest.approx(0.02, rel=1e-9)  # the distance
    # With another value of a parameter.
    integrator.setExpressionParameterValue(0, "r", 0.4)
    assert reported(exact) == pytest.approx((0.25 - 0.16) / (2 * 0.5) / 0.1, rel=1e-9)


def test_constant_temperature() -> None:
    integrator = VariableStepRattleLangevinIntegrator(300, 1, 0.002)
    simulation = make_simulation(integrator)
    reporter = StepSizeReporter(None, 5)
    simulation.reporters.append(reporter)
    simulation.step(5)
    row = reporter.rows[0]
    assert row["Step Size (ps)"] == 0.002
    assert row["Monitor U"] == integrator.getMonitorValue() > 0
    assert row["Force Evaluations"] == integrator.getNumForceEvaluations()
    assert row["Constraint Error"] < 1e-8


@pytest.mark.parametrize("kind", [VariableStepRattleIntegrator, CustomVariableStepRattleIntegrator])
def test_an_integrator_from_a_file(kind: type, tmp_path: Path) -> None:
    """Simulation reads it, as a bare openmm.Integrator or CustomIntegrator."""
    waters = rigid_waters(4)
    path = tmp_path / "integrator.xml"
    path.write_text(openmm.XmlSerializer.serialize(kind(0.001, monitors=[kind.ConstraintAndAppliedForce])))
    simulation = app.Simulation(
        waters.topology, waters.system, str(path), openmm.Platform.getPlatformByName("Reference")
    )
    simulation.context.setPositions(waters.positions)
    simulation.context.setVelocities(waters.velocities)
    simulation.reporters.append(reporter := StepSizeReporter(None, 1))
    run_for_time(simulation, 0.02, every=0.01)
    assert [row["Time (ps)"] for row in reporter.rows] == [0.01, 0.02]
    assert all(row["Step Density"] != 1 for row in reporter.rows)
    assert type(simulation.integrator) is kind


def test_a_time_beyond_the_digits_of_a_step() -> None:
    simulation = make_simulation(VariableStepRattleIntegrator(0.001, automatic=True))
    simulation.context.setTime(1e15)
    with pytest.raises(openmm.OpenMMException, match="makes no way"):
        run_for_time(simulation, 16)
