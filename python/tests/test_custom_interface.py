# OpenMM-VRATTLE: the CustomIntegrator as a user meets it: settings, errors, copies, saved runs, reporters, changes of
# state. SPDX-License-Identifier: MIT

from __future__ import annotations

import copy
import gc
import io
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
import openmmvrattle
import pytest
from custom_support import largest, light_molecules, open_on, platform_parameters, variable
from dense_reference import (
    chain,
    energy_of,
    open_context,
    positions_of,
    thermal_velocities,
    time_of,
    value,
    velocities_of,
    waters,
)
from openmm import app, unit
from openmmvrattle import CustomVariableStepRattleIntegrator as Custom
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import alanine_dipeptide, argon_cluster, rigid_waters
from run_support import solvated

pytestmark = pytest.mark.filterwarnings("ignore:.etNormOrder:DeprecationWarning")

SETTINGS: list[dict[str, Any]] = [
    {},
    {"updateMethod": 2},
    {"minimumStepSize": 0.0003, "maximumStepSize": 1.5 * unit.femtosecond},
    {"minimumStepSize": 0, "maximumStepSize": 0},
    {"constraintTolerance": 3e-10},
    {"monitors": []},
    {"monitors": [(5, 0.1, 1 / 3), 6], "referenceMonitorValue": 1234.5, "normOrder": 5.5, "updateMethod": 1},
    {"monitors": [10, 3], "monitorForceGroup": 3},
]


def settings_of(integrator: Any) -> dict[str, Any]:
    names = ["NominalStepSize", "StepSize", "MinimumStepSize", "MaximumStepSize", "UpdateMethod", "NormOrder"]
    names += ["ConstraintTolerance", "MonitorForceGroup", "NumMonitors", "StepDensity"]
    names += ["NumForceEvaluations", "NumSolverIterations", "NumRescues"]
    result = {name: getattr(integrator, "get" + name)() for name in names}
    monitors = range(integrator.getNumMonitors())
    result["monitors"] = [integrator.getMonitor(k) for k in monitors]
    result["references"] = [integrator.getReferenceMonitorValue(k) for k in monitors]
    return result


def trace(context: openmm.Context, integrator: Custom, steps: int) -> np.ndarray:
    """Everything that can be seen of some more steps."""
    numbers = []
    for _ in range(steps):
        integrator.step(1)
        numbers += [integrator.getStepDensity(), value(integrator.getStepSize()), time_of(context)]
    numbers += [integrator.getReferenceMonitorValue(k) for k in range(integrator.getNumMonitors())]
    numbers += [context.getStepCount()]
    return np.concatenate([numbers, positions_of(context).ravel(), velocities_of(context).ravel()])


@pytest.mark.parametrize("chosen", SETTINGS, ids=str)
def test_settings_are_those_of_the_plugin(chosen: dict[str, Any]) -> None:
    ours, plugin = Custom(0.001, **chosen), VariableStepRattleIntegrator(0.001, **chosen)
    if "monitors" not in chosen:
        plugin.clearMonitors()
        plugin.addMonitor(VariableStepRattleIntegrator.ConstraintForce)
    assert settings_of(ours) == settings_of(plugin)
    for each in (ours, plugin):
        each.setNominalStepSize(0.9 * unit.femtosecond)
        each.setNormOrder(3)
    assert settings_of(ours) == settings_of(plugin)
    kinds = [name for name in dir(VariableStepRattleIntegrator) if name[0].isupper()]
    assert len(kinds) >= 14
    for name in kinds:
        assert getattr(Custom, name) == getattr(VariableStepRattleIntegrator, name)


@pytest.mark.parametrize(
    "act, exception, words",
    [
        (lambda: Custom(-0.001), openmm.OpenMMException, "nominal step size must be positive"),
        (lambda: Custom(float("nan")), openmm.OpenMMException, "nominal step size must be positive"),
        (lambda: Custom("0.001"), TypeError, "stepSize must be a number or a Quantity"),
        (lambda: Custom(1 * unit.nanometer), TypeError, "not a Quantity in nanometer"),
        (lambda: Custom(0.001, maximumStepSize=-1), openmm.OpenMMException, "maximum step size must be positive"),
        (lambda: Custom(0.001, constraintTolerance=0), openmm.OpenMMException, "tolerance must be positive"),
        (lambda: Custom(0.001, normOrder=0.5), openmm.OpenMMException, "order of a norm must be at least 1"),
        (lambda: Custom(0.001, monitorForceGroup=32), openmm.OpenMMException, "between 0 and 31"),
        (lambda: Custom(0.001, updateMethod=3), openmm.OpenMMException, "no update method 3"),
        (lambda: Custom(0.001, updateMethod=1), openmm.OpenMMException, "Explicit needs the constraint force"),
        (lambda: Custom(0.001, monitors=1), TypeError, "monitors must be a list"),
        (lambda: Custom(0.001, monitors=["x"]), TypeError, "kind must be an integer"),
        (lambda: Custom(0.001, monitors=[11]), openmm.OpenMMException, "no kind of monitor 11"),
        (lambda: Custom(0.001, monitors=[(1, 0)]), openmm.OpenMMException, "weight of a monitor must be positive"),
        (lambda: Custom(0.001, monitors=[(1, 1, -1)]), openmm.OpenMMException, "power of a monitor must be positive"),
        (lambda: Custom(0.001, referenceMonitorValue=-1), openmm.OpenMMException, "reference value must be positive"),
        (lambda: Custom(0.001).getMonitor(1), openmm.OpenMMException, "no monitor 1"),
        (lambda: Custom(0.001).getMonitorValue(), openmm.OpenMMException, "known after the first step"),
        (lambda: Custom(0.001).getMultipliers(), openmm.OpenMMException, "use VariableStepRattleIntegrator"),
        (lambda: Custom(0.001).step(1), openmm.OpenMMException, "not bound to a context"),
        (lambda: Custom(0.001).stepTo(1), openmm.OpenMMException, "not bound to a context"),
        (lambda: Custom(0.001).reverse(), openmm.OpenMMException, "not bound to a context"),
        (lambda: Custom(0.001).calibrate(10), openmm.OpenMMException, "not bound to a context"),
        (lambda: Custom(0.001).step(1.5), TypeError, "steps must be an integer"),
        (lambda: Custom.cast(openmm.CustomIntegrator(0.001)), TypeError, "is not a CustomVariableStepRattle"),
        (lambda: Custom.cast(openmm.VerletIntegrator(0.001)), TypeError, "is not a CustomVariableStepRattle"),
    ],
)
def test_wrong_values_are_refused_in_one_sentence(act: Callable, exception: type, words: str) -> None:
    with pytest.raises(exception, match=words) as refusal:
        act()
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("kind", ["ConstraintMultipliers", "MultiplierPNorm", "MaxForce", "MaxParticleArcLength"])
def test_monitors_that_cannot_be_expressed_name_another(kind: str) -> None:
    integrator = Custom(0.001)
    with pytest.raises(openmm.OpenMMException, match=f"{kind} needs .*: use [A-Z].*, or VariableStepRattleIntegrator"):
        integrator.addMonitor(getattr(Custom, kind))
    assert integrator.getNumMonitors() == 1


def test_the_program_is_fixed_once_there_is_a_context() -> None:
    model = chain()
    integrator = Custom(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    for act in (
        lambda: integrator.addMonitor(Custom.AppliedForce),
        integrator.clearMonitors,
        lambda: integrator.setUpdateMethod(Custom.Bounded),
        lambda: integrator.setMonitorForceGroup(2),
    ):
        with pytest.raises(openmm.OpenMMException, match="fixed once there is a Context"):
            act()
    integrator.setUpdateMethod(Custom.SemiExplicit)  # as it is
    integrator.step(1)
    integrator.setNominalStepSize(0.0005)
    integrator.setMaximumStepSize(0.0008)
    integrator.setConstraintTolerance(1e-9)
    integrator.setNormOrder(4)
    integrator.step(20)
    assert time_of(context) < 0.02
    with pytest.raises(openmm.OpenMMException, match="force groups cannot change after the first step"):
        integrator.setIntegrationForceGroups({1})
    owner = openmm.CompoundIntegrator()
    part = Custom(0.001)
    owner.addIntegrator(part)
    with pytest.raises(openmm.OpenMMException, match="part of another one"):
        part.clearMonitors()


def test_a_nominal_step_changed_in_a_run_starts_no_oscillation() -> None:
    model = chain()
    integrator = Custom(0.0005, constraintTolerance=1e-12)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(50)
    before = integrator.getStepDensity()
    integrator.setNominalStepSize(0.00025)
    integrator.setMaximumStepSize(0.0005)
    sizes = []
    for _ in range(50):
        integrator.step(1)
        sizes.append(value(integrator.getStepSize()))
    assert sizes[0] == pytest.approx(0.00025 / before, rel=0.02)
    assert np.mean(np.abs(np.diff(sizes, 4))) / 16 < 1e-3 * np.mean(sizes)
    assert integrator.getNumRescues() == 0
    assert context.getStepCount() == 100


# Copies

COPIES: dict[str, Callable[[Custom], Any]] = {
    "XML and cast": lambda i: Custom.cast(openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(i))),
    "XML": lambda i: openmmvrattle.XmlSerializer.deserialize(openmmvrattle.XmlSerializer.serialize(i)),
    "clone": openmmvrattle.XmlSerializer.clone,
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda i: pickle.loads(pickle.dumps(i)),
}


# All ways go through the same XML.
@pytest.mark.parametrize(
    ("way", "chosen"), [*(("XML", chosen) for chosen in SETTINGS), *((way, SETTINGS[-1]) for way in COPIES)], ids=str
)
def test_copies_have_every_setting(way: str, chosen: dict[str, Any]) -> None:
    model = chain()
    integrator = Custom(0.0005, **chosen)
    integrator.setIntegrationForceGroups({0, 4})
    duplicate = COPIES[way](integrator)
    assert type(duplicate) is Custom and duplicate is not integrator
    assert settings_of(duplicate) == settings_of(integrator)
    duplicate.setNominalStepSize(0.0007)
    assert integrator.getNominalStepSize()._value == 0.0005
    if 10 in [kind[0] if isinstance(kind, tuple) else kind for kind in chosen.get("monitors", [])]:
        return
    # Of one that runs as well; the copy has nothing of the run, and the original goes on.
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(10)
    duplicate = COPIES[way](integrator)
    assert duplicate.getStepDensity() == 1
    if duplicate.getNumMonitors():
        assert duplicate.getReferenceMonitorValue() == chosen.get("referenceMonitorValue", 0)
    assert duplicate.getIntegrationForceGroups() == integrator.getIntegrationForceGroups() == 0b10001
    other = open_context(model.system(), duplicate, "Reference", model)
    duplicate.step(10)
    assert np.array_equal(positions_of(other), positions_of(context))
    integrator.step(1)
    assert context.getStepCount() == 11


def test_a_copy_keeps_subclass_and_attributes() -> None:
    class Named(Custom):
        pass

    integrator = Named(0.001)
    integrator.names = ["first"]
    for duplicate in (copy.copy(integrator), copy.deepcopy(integrator)):
        assert type(duplicate) is Named
        assert duplicate.names == ["first"] and duplicate.names is not integrator.names


def test_a_newer_program_is_refused() -> None:
    xml = openmm.XmlSerializer.serialize(Custom(0.001))
    newer = xml.replace('name="vrattle_version" value="2"', 'name="vrattle_version" value="7"').replace(
        'value="2" name="vrattle_version"', 'value="7" name="vrattle_version"'
    )
    newer = newer.replace('initialValue="2" name="vrattle_version"', 'initialValue="7" name="vrattle_version"')
    assert newer != xml
    with pytest.raises(openmm.OpenMMException, match="version 7 of its program and this package reads version 2"):
        Custom.cast(openmm.XmlSerializer.deserialize(newer))


def test_a_simulation_from_a_file(tmp_path: Any) -> None:
    """app.Simulation reads an integrator with OpenMM's serializer and binds it; its class can be changed then too."""
    test = rigid_waters()
    (tmp_path / "integrator.xml").write_text(openmm.XmlSerializer.serialize(Custom(0.001, maximumStepSize=0.0015)))
    reference = openmm.Platform.getPlatform("Reference")
    simulation = app.Simulation(test.topology, test.system, str(tmp_path / "integrator.xml"), reference)
    simulation.context.setPositions(test.positions)
    simulation.context.setVelocities(test.velocities)
    assert type(simulation.integrator) is openmm.CustomIntegrator
    integrator = Custom.cast(simulation.integrator)
    simulation.step(30)
    assert value(integrator.getMaximumStepSize()) == 0.0015
    assert time_of(simulation.context) != pytest.approx(0.03, rel=1e-6)
    assert time_of(simulation.context) == variable(integrator, "clock")


# Saved runs


@pytest.mark.parametrize("platform, precision, bound", platform_parameters(double=1e-9, mixed=1e-6))
@pytest.mark.parametrize("way", ["checkpoint", "state as XML"])
def test_a_restored_run_goes_on(way: str, platform: str, precision: str, bound: float) -> None:
    test = rigid_waters()
    integrator = Custom(0.001)
    context = open_on(platform, precision, test.system, integrator, test)
    integrator.step(30)
    if way == "checkpoint":
        saved = context.createCheckpoint()
    else:
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        saved = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(state))
    expected = trace(context, integrator, 20)
    other = Custom(0.0007)  # The settings come with the run.
    new = open_on(platform, precision, test.system, other)
    (new.loadCheckpoint if way == "checkpoint" else new.setState)(saved)
    restored = trace(new, other, 20)
    if platform == "Reference" and way == "checkpoint":
        assert np.array_equal(restored, expected)
    np.testing.assert_allclose(restored, expected, rtol=bound, atol=bound)
    assert value(other.getNominalStepSize()) == 0.001
    # And back in the same Context.
    (context.loadCheckpoint if way == "checkpoint" else context.setState)(saved)
    np.testing.assert_allclose(trace(context, integrator, 20), expected, rtol=bound, atol=bound)


def test_reinitialize_keeps_the_run() -> None:
    test = rigid_waters()
    integrator, undisturbed = Custom(0.001), Custom(0.001)
    contexts = [open_context(test.system, each, "Reference", test) for each in (integrator, undisturbed)]
    for each in (integrator, undisturbed):
        each.step(20)
    contexts[0].reinitialize(preserveState=True)
    assert np.array_equal(trace(contexts[0], integrator, 20), trace(contexts[1], undisturbed, 20))


# Time


def test_reporters_see_the_true_time(platform: str) -> None:
    test = rigid_waters()
    integrator = Custom(0.001)
    simulation = app.Simulation(test.topology, test.system, integrator, openmm.Platform.getPlatform(platform))
    simulation.context.setPositions(test.positions)
    simulation.context.setVelocities(test.velocities)
    table = io.StringIO()
    simulation.reporters.append(app.StateDataReporter(table, 7, step=True, time=True, totalEnergy=True))
    simulation.step(70)
    rows = np.loadtxt(io.StringIO(table.getvalue()), delimiter=",", comments="#")
    other = Custom(0.001)
    context = open_on(platform, "double", test.system, other, test)
    times, sizes = [], []
    for _ in range(70):
        other.step(1)
        sizes.append(value(other.getStepSize()))
        times.append(time_of(context))
    np.testing.assert_allclose(times, np.cumsum(sizes), rtol=1e-13)
    np.testing.assert_allclose(rows[:, 1], times[6::7], rtol=1e-6)
    assert np.ptp(sizes) > 1e-5
    # A time that the user sets is where time goes on from.
    simulation.context.setTime(100.0)
    simulation.step(10)
    assert 100 < time_of(simulation.context) < 100.02


@pytest.mark.parametrize("update, kind", [("SemiExplicit", "ConstraintForce"), ("Explicit", "AppliedForce")])
def test_step_to_meets_the_time(update: str, kind: str) -> None:
    model = chain()
    integrator = Custom(0.0005, constraintTolerance=1e-12, monitors=[getattr(Custom, kind)])
    integrator.setUpdateMethod(getattr(Custom, update))
    context = open_context(model.system(), integrator, "Reference", model)
    start = energy_of(context)
    densities = []
    for time in (0.0002, 0.01, 0.02, 0.02, 0.015, 0.0201, 0.04):
        integrator.stepTo(time)
        assert time_of(context) == max(time, 0.02 if time == 0.015 else 0)
    for _ in range(60):
        integrator.step(1)
        densities.append(integrator.getStepDensity())
    assert abs(energy_of(context) - start) < 0.05
    assert np.mean(np.abs(np.diff(densities, 4))) / 16 < 2e-3
    assert integrator.getNumRescues() == 0
    assert context.getStepCount() > 80
    with pytest.raises(openmm.OpenMMException, match="must be finite"):
        integrator.stepTo(float("inf"))


# Changes of the state


def test_a_user_who_changes_the_state_starts_the_density_afresh() -> None:
    """Hot velocities in mid-run: no oscillation, and the reference value stays."""
    model = chain()
    integrator, fresh = (Custom(0.00025, constraintTolerance=1e-12) for _ in range(2))
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(50)
    reference = integrator.getReferenceMonitorValue()
    c = model.constraints()
    hot = thermal_velocities(c, positions_of(context).ravel(), 900.0, 3)
    context.setVelocities(hot)
    fresh.setReferenceMonitorValue(reference)
    other = open_context(model.system(), fresh, "Reference")
    other.setPositions(positions_of(context))
    other.setVelocities(hot)
    assert integrator.getReferenceMonitorValue() == reference
    for n in range(30):
        integrator.step(1)
        fresh.step(1)
        assert integrator.getStepDensity() == pytest.approx(fresh.getStepDensity(), rel=1e-9)
        assert bool(variable(integrator, "fresh")) == (n == 0)
    np.testing.assert_allclose(positions_of(context), positions_of(other), rtol=0, atol=1e-10)
    # Positions alone, as after a minimization, away from the constraints.
    context.setPositions(1.001 * positions_of(context))
    integrator.step(1)
    assert variable(integrator, "fresh") == 1
    integrator.step(1)
    assert variable(integrator, "fresh") == 0


def test_what_changes_by_rounding_only_does_not() -> None:
    """CMMotionRemover, which app.ForceField adds to every system, changes all velocities at every step."""
    model = waters()
    system = model.system()
    system.addForce(openmm.CMMotionRemover(1))
    integrator = Custom(0.0005, constraintTolerance=1e-12)
    context = open_context(system, integrator, "Reference", model)
    changes = []
    for _ in range(50):
        integrator.step(1)
        changes.append(variable(integrator, "change"))
    assert changes == [1] + [0] * 49
    integrator.reverse()
    integrator.step(50)
    assert largest(positions_of(context) - model.positions) < 1e-9


def test_a_thermostat() -> None:
    """It changes the state within steps: the density follows, at no more evaluations, and the ensemble is right."""
    test = alanine_dipeptide()
    system = copy.deepcopy(test.system)
    thermostat = openmm.AndersenThermostat(300, 20)
    thermostat.setRandomNumberSeed(4)
    system.addForce(thermostat)
    integrator = Custom(0.001, monitors=[Custom.ConstraintAndAppliedForce])
    context = open_context(system, integrator, "CPU", test)
    kinetic, densities = [], []
    for _ in range(300):
        integrator.step(10)
        kinetic.append(context.getState(energy=True).getKineticEnergy()._value)
        densities.append(integrator.getStepDensity())
    freedom = 3 * system.getNumParticles() - system.getNumConstraints()
    temperature = 2 * np.mean(kinetic) / (freedom * 0.00831446)
    print("temperature", temperature, "rescues", integrator.getNumRescues())
    assert 260 < temperature < 340
    assert integrator.getNumForceEvaluations() == 3001
    assert integrator.getNumRescues() < 30
    assert 0.4 < min(densities) and max(densities) < 10


def test_a_barostat() -> None:
    """It moves molecules within steps: the density follows, and the volume changes."""
    modeller, field = solvated(count=60)
    cutoff = 0.5 * unit.nanometer
    system = field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=cutoff)
    barostat = openmm.MonteCarloBarostat(1, 300, 5)
    barostat.setRandomNumberSeed(2)
    system.addForce(barostat)
    integrator = Custom(0.001, monitors=[Custom.ConstraintAndAppliedForce])
    context = open_context(system, integrator, "CPU")
    context.setPositions(modeller.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 100, 50)
    context.setVelocitiesToTemperature(300, 1)
    before = context.getState().getPeriodicBoxVolume()._value
    densities, changes = [], 0.0
    for _ in range(150):
        integrator.step(1)
        densities.append(integrator.getStepDensity())
        changes += variable(integrator, "change")
    assert 2 < changes <= 31
    assert context.getState().getPeriodicBoxVolume()._value != before
    assert 0.5 < min(densities) and max(densities) < 5
    assert integrator.getNumRescues() < 5


class Counter:
    """A force in Python that counts how often it is computed."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, state: openmm.State) -> tuple[float, np.ndarray]:
        self.count += 1
        x = state.getPositions(asNumpy=True)._value
        return 5.0 * float(np.sum(x**2)), -10.0 * x


@pytest.mark.parametrize(
    "kind, update", [("ConstraintForce", 0), ("AppliedForce", 1), ("VectorField", 0), ("ArcLength", 2)]
)
@pytest.mark.parametrize("reference", [0.0, 500.0])
def test_one_evaluation_of_the_forces_a_step(reference: float, kind: str, update: int) -> None:
    model, counter = chain(), Counter()
    system = model.system()
    system.addForce(openmm.PythonForce(counter))
    integrator = Custom(0.0005, update, monitors=[getattr(Custom, kind)], referenceMonitorValue=reference)
    context = open_context(system, integrator, "Reference", model)
    integrator.step(1)
    assert counter.count == (2 if reference == 0 else 4)
    integrator.step(30)
    assert counter.count == (32 if reference == 0 else 34)
    assert integrator.getNumForceEvaluations() == counter.count
    integrator.reverse()
    integrator.step(5)
    assert counter.count == integrator.getNumForceEvaluations()
    assert context.getStepCount() == 36


# Monitors


def test_the_group_of_the_monitor_is_left_out_of_the_dynamics() -> None:
    model = chain()

    def run(cls: Any, weight: float, monitors: list[int]) -> tuple[np.ndarray, tuple[float, int]]:
        system = model.system()
        energy = openmm.CustomExternalForce("k*(1 + x^2)")
        energy.addGlobalParameter("k", weight)
        for i in range(8):
            energy.addParticle(i)
        energy.setForceGroup(5)
        system.addForce(energy)
        integrator = cls(0.0005, cls.Explicit if monitors == [10] else cls.SemiExplicit, monitors=monitors)
        integrator.setMonitorForceGroup(5)
        integrator.setConstraintTolerance(1e-12)
        context = open_context(system, integrator, "Reference", model)
        integrator.step(100)
        if cls is Custom:
            uses_group = Custom.ForceGroupEnergy in monitors
            assert integrator.getIntegrationForceGroups() == (-1 - (1 << 5) if uses_group else -1)
        return positions_of(context), (integrator.getMonitorValue(), integrator.getNumForceEvaluations())

    ours, numbers = run(Custom, 1.0, [Custom.ForceGroupEnergy])
    plugin, others = run(VariableStepRattleIntegrator, 1.0, [VariableStepRattleIntegrator.ForceGroupEnergy])
    assert numbers[0] == pytest.approx(others[0], rel=1e-6)
    assert numbers[1] == 101
    assert largest(ours - plugin) < 1e-5
    # The size of the energy is of no consequence, so it exerts no force; as it does when it is not the monitor.
    assert largest(run(Custom, 1000.0, [Custom.ForceGroupEnergy])[0] - ours) < 1e-12
    assert largest(run(Custom, 1000.0, [Custom.AppliedForce])[0] - run(Custom, 1.0, [Custom.AppliedForce])[0]) > 1e-3


def test_calibration() -> None:
    model = light_molecules()
    references = []
    for cls in (VariableStepRattleIntegrator, Custom):
        integrator = cls(0.0005, monitors=[cls.ConstraintForce, cls.ForcePNorm], constraintTolerance=1e-10)
        context = open_context(model.system(), integrator, "Reference", model)
        for _ in range(2):  # before the first step, and in the course of a run
            integrator.calibrate(50)
            integrator.step(10)
        assert context.getStepCount() == 20
        references.append([integrator.getReferenceMonitorValue(k) for k in range(2)])
        assert time_of(context) == pytest.approx(0.01, rel=0.5)
    np.testing.assert_allclose(references[1], references[0], rtol=0.02)
    with pytest.raises(openmm.OpenMMException, match="positive number of steps"):
        integrator.calibrate(0)


def test_a_start_that_is_calm() -> None:
    """A molecule in free flight that does not turn: no force anywhere, so the steps are nominal until there is one."""
    model = waters(1)
    system = model.system()
    wall = openmm.CustomExternalForce("1e4*step(x - 0.25)*(x - 0.25)^2")
    for i in range(3):
        wall.addParticle(i)
    system.addForce(wall)
    integrator = Custom(0.001, constraintTolerance=1e-10)
    context = open_context(system, integrator, "Reference", model)
    context.setPositions(model.positions - np.max(model.positions, axis=0))
    context.setVelocities(np.tile([5.0, 0.0, 0.0], (3, 1)))
    start, sizes, references = energy_of(context), [], []
    for _ in range(100):
        integrator.step(1)
        sizes.append(value(integrator.getStepSize()))
        references.append(integrator.getReferenceMonitorValue())
    calm = references.count(0.0)
    assert 40 < calm < 55  # a quarter of a nanometre at 5 nm/ps
    np.testing.assert_allclose(sizes[: calm + 1], 0.001, rtol=1e-12)
    assert len(set(references[calm:])) == 1  # the first value above rounding stays
    assert max(sizes) / min(sizes) > 1.1
    assert abs(energy_of(context) - start) < 0.02 * start
    assert integrator.getNumRescues() == 0


def test_a_calm_calibration_leaves_the_reference_value_for_later() -> None:
    model = waters(1)
    integrator = Custom(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    context.setVelocities(np.tile([1.0, 0.0, 0.0], (3, 1)))
    integrator.calibrate(5)
    assert integrator.getReferenceMonitorValue() < 1e-3  # what rounding leaves
    assert time_of(context) == 0


def test_without_constraints_the_default_monitor_is_that_of_the_applied_force(platform: str) -> None:
    test = argon_cluster(8)
    runs = []
    for settings in ({}, {"monitors": [Custom.ConstraintAndAppliedForce]}):
        integrator = Custom(0.004, **settings)
        context = open_context(test.system, integrator, platform, test)
        integrator.step(50)
        assert integrator.getMonitor(0) == (Custom.ConstraintAndAppliedForce, 1.0, 1.0)
        runs.append([integrator.getStepDensity(), integrator.getMonitorValue(), *positions_of(context).ravel()])
    np.testing.assert_array_equal(runs[0], runs[1])
    assert runs[0][0] != 1
    integrator = Custom(0.004)
    assert integrator.getMonitor(0)[0] == Custom.ConstraintForce
    integrator.clearMonitors()
    integrator.addMonitor(Custom.ConstraintForce)
    context = open_context(test.system, integrator, platform, test)
    with pytest.raises(openmm.OpenMMException, match="ConstraintForce needs constraints, and the System has none"):
        integrator.step(1)


def test_step_size_zero_is_for_energies() -> None:
    model = chain()
    integrator = Custom(0)
    context = open_context(model.system(), integrator, "Reference", model)
    assert np.isfinite(energy_of(context))
    with pytest.raises(openmm.OpenMMException, match="no step can be taken with the nominal step size 0"):
        integrator.step(1)
    integrator.setStepSize(0.0005)
    integrator.step(1)
    assert time_of(context) == value(integrator.getStepSize()) > 0


def test_bounds_and_step_in_any_order() -> None:
    model = chain()
    integrator = Custom(0.0005)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.setMinimumStepSize(0.001)
    integrator.setMaximumStepSize(0.004)
    words = "the minimum is 0.001 ps, the nominal one 0.0005 ps and the maximum 0.004 ps"
    for act in (lambda: integrator.step(1), lambda: integrator.stepTo(0.1), integrator.reverse):
        with pytest.raises(openmm.OpenMMException, match=words):
            act()
    integrator.setNominalStepSize(0.002)
    integrator.step(3)
    assert context.getStepCount() == 3
    # The most recent step, or the one that was set since.
    assert value(integrator.getStepSize()) != 0.002
    integrator.setStepSize(0.0015)
    assert value(integrator.getStepSize()) == 0.0015
    # In one order and the other the run is the same.
    ends = []
    for order in (("Minimum", "Nominal", "Maximum"), ("Maximum", "Nominal", "Minimum")):
        integrator = Custom(0.005)
        for name in order:
            getattr(integrator, f"set{name}StepSize")({"Minimum": 0.0004, "Nominal": 0.0005, "Maximum": 0.0006}[name])
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.step(20)
        ends.append(positions_of(context))
    np.testing.assert_array_equal(*ends)


def test_forces_that_are_not_numbers_raise() -> None:
    system = openmm.System()
    system.addParticle(1.0)
    system.addParticle(1.0)
    system.addConstraint(0, 1, 0.1)
    force = openmm.CustomExternalForce("sqrt(0.11 - x)")
    force.addParticle(1)
    system.addForce(force)
    integrator = Custom(0.001, monitors=[Custom.AppliedForce])
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions([[0, 0, 0], [0.1, 0, 0]])
    context.setVelocities([[1, 0, 0], [1, 0, 0]])
    with pytest.raises(openmm.OpenMMException, match="not finite; the Context is in the state before this step"):
        integrator.step(5000)


def test_the_context_is_found_and_not_kept_alive() -> None:
    model = chain()
    integrator = Custom(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    vars(context)  # makes a dictionary of its attributes, which refers to the integrator in place of the Context
    integrator.step(1)
    assert time_of(context) == variable(integrator, "clock") == 0.001
    del context
    gc.collect()
    with pytest.raises(openmm.OpenMMException, match="not bound"):
        integrator.step(1)


def test_a_context_that_cannot_be_found_is_asked_for() -> None:
    """Steps without it would be without the start on the constraints, the checks, and the time of the Context."""
    model = chain()
    integrator = Custom(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    gc.freeze()
    try:
        with pytest.raises(openmm.OpenMMException, match="tell it with attachContext"):
            integrator.step(1)
        assert time_of(context) == 0
        integrator.attachContext(context)
        integrator.step(1)
        assert time_of(context) == 0.001
    finally:
        gc.unfreeze()


@pytest.mark.parametrize("platform, precision, bound", platform_parameters(mixed=1e-6, single=1e-4))
def test_molecules_put_back_into_the_box_are_no_change(platform: str, precision: str, bound: float) -> None:
    """Every 250 steps a GPU sorts the particles anew and moves molecules by lengths of the box."""
    model = waters()
    system = model.system()
    force, edge = system.getForce(0), 1.3
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.6)
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    integrator = Custom(0.001, monitors=[Custom.ConstraintAndAppliedForce])
    context = open_on(platform, precision, system, integrator, model)
    context.setVelocities(model.velocities + np.array([8.0, 0.0, 0.0]))
    changes, jumps, last = 0.0, 0.0, np.zeros(0)
    for n in range(270):
        integrator.step(1)
        changes += variable(integrator, "change")
        if n in (247, 248, 249, 250, 251):
            x = np.array(integrator.getPerDofVariableByName("vrattle_end"))[:, 0]
            jumps = max(jumps, largest(x - last)) if last.size else 0.0
            last = x
    assert jumps > edge - 0.1  # one or more lengths of the box
    assert changes == 1
    assert integrator.getNumRescues() == 0


def test_inside_a_compound_integrator() -> None:
    """OpenMM takes its steps without our Python: all is the same but the Context's time and the checks."""
    model = chain()
    compound = openmm.CompoundIntegrator()
    part = Custom(0.0005, constraintTolerance=1e-10)
    compound.addIntegrator(part)
    compound.addIntegrator(openmm.VerletIntegrator(0.0005))
    context = open_context(model.system(), compound, "Reference", model)
    start = energy_of(context)
    compound.step(200)
    assert abs(energy_of(context) - start) < 0.1
    assert part.getStepDensity() != 1
    assert part.getNumRescues() == 0
    # The plugin's time, by itself, is the sum of the steps; here only the variable is, until the steps are ours.
    alone = Custom(0.0005, constraintTolerance=1e-10)
    other = open_context(model.system(), alone, "Reference", model)
    alone.step(200)
    assert variable(part, "clock") == pytest.approx(time_of(other), rel=1e-9)
    assert largest(positions_of(context) - positions_of(other)) < 1e-9
    with pytest.raises(openmm.OpenMMException, match="tell it with attachContext"):
        part.stepTo(1.0)
    part.attachContext(context)
    time = time_of(context)
    part.stepTo(time + 0.01)
    assert time_of(context) == pytest.approx(time + 0.01, abs=1e-15)
    alone.stepTo(time_of(other) + 0.01)
    assert largest(positions_of(context) - positions_of(other)) < 1e-6
    with pytest.raises(TypeError, match="context must be a Context"):
        part.attachContext(compound)


def test_the_plugin_runs_where_openmm_has_a_faster_platform() -> None:
    """Without a platform's name OpenMM takes the fastest: OpenCL, CUDA or HIP where they are there."""
    script = (
        "import openmm, openmmvrattle\n"
        "from openmmvrattle.testsystems import rigid_waters\n"
        "water = rigid_waters()\n"
        "integrator = openmmvrattle.VariableStepRattleIntegrator(0.001)\n"
        "context = openmm.Context(water.system, integrator)\n"
        "context.setPositions(water.positions)\n"
        "integrator.step(5)\n"
        "print(context.getPlatform().getName(), [openmm.Platform.getPlatform(i).getName() for i in\n"
        "      range(openmm.Platform.getNumPlatforms())])\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OPENMM_DEFAULT_PLATFORM"}
    result = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    print(result.stdout)
    taken, *names = re.findall(r"\w+", result.stdout.splitlines()[-1])
    assert taken == max(names, key=lambda name: openmm.Platform.getPlatform(name).getSpeed())
