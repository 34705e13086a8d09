# OpenMM-VRATTLE: changes of the state in the middle of a run; nothing stale is used, and nothing renewed without need.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import UPDATES, chain, open_context, positions_of, time_of, value, velocities_of, waters
from openmm import app
from openmmvrattle import VariableStepRattleIntegrator
from run_support import assert_same_run, fastest_platform, make_integrator, relax, smooth_cutoff, solvated, with_update

BOX = 0.9


def chain_in_a_box(
    strength: float = 20.0, each: float = 1.0, box: float = BOX
) -> tuple[openmm.System, openmm.CustomExternalForce]:
    """A chain drawn to the nearest image of a point: a force with a global, a per-particle and a box dependence."""
    system = chain().system()
    force = openmm.CustomExternalForce("strength*each*periodicdistance(x,y,z,0.1,0.2,0.3)^2")
    force.addGlobalParameter("strength", strength)
    force.addPerParticleParameter("each")
    for i in range(8):
        force.addParticle(i, [each])
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors((box, 0, 0), (0, box, 0), (0, 0, box))
    return system, force


Change = Callable[[openmm.Context, openmm.CustomExternalForce], dict[str, float]]


def change_positions(context: openmm.Context, force: openmm.CustomExternalForce) -> dict[str, float]:
    context.setPositions(positions_of(context) @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + 0.04)
    return {}


def change_velocities(context: openmm.Context, force: openmm.CustomExternalForce) -> dict[str, float]:
    context.setVelocities(-1.3 * velocities_of(context))
    return {}


def change_temperature(context: openmm.Context, force: openmm.CustomExternalForce) -> dict[str, float]:
    context.setVelocitiesToTemperature(250, 12)
    return {}


def change_parameter(context: openmm.Context, force: openmm.CustomExternalForce) -> dict[str, float]:
    context.setParameter("strength", 200.0)
    return {"strength": 200.0}


def update_parameters(context: openmm.Context, force: openmm.CustomExternalForce) -> dict[str, float]:
    for i in range(8):
        force.setParticleParameters(i, i, [9.0])
    force.updateParametersInContext(context)
    return {"each": 9.0}


def displace_and_constrain(context: openmm.Context, force: openmm.CustomExternalForce) -> dict[str, float]:
    context.setPositions(positions_of(context) + 0.002 * np.sin(np.arange(24)).reshape(8, 3))
    context.applyConstraints(1e-10)
    context.applyVelocityConstraints(1e-10)
    return {}


def minimise(context: openmm.Context, force: openmm.CustomExternalForce) -> dict[str, float]:
    openmm.LocalEnergyMinimizer.minimize(context, 1.0, 20)
    return {}


CHANGES: list[Change] = [
    change_positions,
    change_velocities,
    change_temperature,
    displace_and_constrain,
    minimise,
]


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("change", CHANGES)
def test_a_change_starts_a_run_of_its_own(change: Change, update: str, platform: str) -> None:
    """Forces, half-step momentum and density are those of a new Context in that state with the same reference."""
    system, force = chain_in_a_box()
    model = chain()
    # Neither a Context nor an integrator may serve twice, so another one shows where the run would have gone.
    used, alone = (with_update(make_integrator(setConstraintTolerance=1e-12), update) for _ in range(2))
    context = open_context(system, used, platform, model)
    unchanged = open_context(chain_in_a_box()[0], alone, platform, model)
    used.step(40)
    alone.step(40)
    assert np.array_equal(positions_of(context), positions_of(unchanged))
    evaluations = used.getNumForceEvaluations()
    assert evaluations == 41
    arguments = change(context, force)
    q, v = positions_of(context), velocities_of(context)
    fresh = with_update(make_integrator(setConstraintTolerance=1e-12), update)
    fresh.setReferenceMonitorValue(used.getReferenceMonitorValue())
    other = open_context(chain_in_a_box(**arguments)[0], fresh, platform)
    other.setPositions(q)
    other.setVelocities(v)
    # CPU: the forces of this System are those of Reference.
    assert_same_run(used, context, fresh, other)
    # A start costs the forces at the start, and its first step is taken again with the density that belongs to it.
    assert used.getNumForceEvaluations() - evaluations <= 32
    assert fresh.getNumForceEvaluations() <= 32
    # The test could fail: going on as before would lead elsewhere.
    alone.step(30)
    assert np.max(np.abs(positions_of(unchanged) - positions_of(context))) > 1e-5


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("change", [change_parameter, update_parameters])
def test_forces_that_change_cost_one_evaluation(change: Change, update: str, platform: str) -> None:
    """The run goes on with the new forces, and its density with the ratio to the monitor that it had."""
    system, force = chain_in_a_box()
    integrator = with_update(make_integrator(kind="ConstraintAndAppliedForce"), update)
    context = open_context(system, integrator, platform, chain())
    integrator.step(40)
    evaluations = integrator.getNumForceEvaluations()
    arguments = change(context, force)
    energies, densities = [], []
    for _ in range(30):
        integrator.step(1)
        energies.append(value(context.getState(energy=True).getPotentialEnergy()))
        energies[-1] += value(context.getState(energy=True).getKineticEnergy())
        densities.append(integrator.getStepDensity())
    assert integrator.getNumForceEvaluations() == evaluations + 31
    # The step is ten times as hard, and the density does not swing to and fro about it.
    assert np.max(np.abs(np.diff(densities, 2)) / densities[0]) < 0.3
    # What is conserved from now on is the energy with the new forces.
    other = VariableStepRattleIntegrator(0.0005, monitors=[])
    fresh = open_context(chain_in_a_box(**arguments)[0], other, platform)
    fresh.setPositions(positions_of(context))
    fresh.setVelocities(velocities_of(context))
    assert value(fresh.getState(energy=True).getPotentialEnergy()) + value(
        fresh.getState(energy=True).getKineticEnergy()
    ) == pytest.approx(energies[-1], rel=1e-6)
    assert max(energies) - min(energies) < 1e-3 * abs(energies[0])


@pytest.mark.parametrize("update", UPDATES)
def test_new_box(update: str, platform: str) -> None:
    """A box that the user sets starts the run afresh, as any change of state by the user does."""
    model = chain()
    used, fresh, alone = (with_update(make_integrator(setConstraintTolerance=1e-12), update) for _ in range(3))
    context = open_context(chain_in_a_box()[0], used, platform, model)
    unchanged = open_context(chain_in_a_box()[0], alone, platform, model)
    used.step(40)
    alone.step(40)
    context.setPeriodicBoxVectors((0.5, 0, 0), (0, 0.5, 0), (0, 0, 0.5))
    fresh.setReferenceMonitorValue(used.getReferenceMonitorValue())
    other = open_context(chain_in_a_box(box=0.5)[0], fresh, platform)
    other.setPositions(positions_of(context))
    other.setVelocities(velocities_of(context))
    start, evaluations = time_of(context), used.getNumForceEvaluations()
    used.step(1)
    # The forces in the new box, and two for a first step with a given reference value, which is taken again.
    assert used.getNumForceEvaluations() == evaluations + 3
    # The first steps have the same forces, so far as half a step more or less may tell.
    used.stepTo(start + 0.02)
    fresh.stepTo(0.02)
    alone.stepTo(start + 0.02)
    difference = np.max(np.abs(positions_of(context) - positions_of(other)))
    effect = np.max(np.abs(positions_of(context) - positions_of(unchanged)))
    print(f"{update}: difference {difference:.1e}, effect of the box {effect:.1e}")
    assert effect > 1e-3
    # Errors of second order in steps of 0.5 fs, which differ by the densities.
    assert difference < 5e-3 * effect
    # The same box once more is no change.
    evaluations = used.getNumForceEvaluations()
    context.setPeriodicBoxVectors((0.5, 0, 0), (0, 0.5, 0), (0, 0, 0.5))
    used.step(3)
    assert used.getNumForceEvaluations() == evaluations + 3


@pytest.mark.parametrize("update", UPDATES)
def test_the_step_after_each_of_many_changes(update: str) -> None:
    """A change after every step: the state used is always the one that was set."""
    model = chain()
    used = with_update(make_integrator(setConstraintTolerance=1e-12), update)
    context = open_context(model.system(), used, "Reference", model)
    used.step(1)
    for i in range(15):
        if i % 3 != 1:
            context.setVelocities((-1.0 if i % 2 else 1.02) * velocities_of(context))
        if i % 3 != 0:
            context.setPositions(positions_of(context) + 0.001 * i)
        fresh = with_update(make_integrator(setConstraintTolerance=1e-12), update)
        fresh.setReferenceMonitorValue(used.getReferenceMonitorValue())
        other = open_context(model.system(), fresh, "Reference")
        other.setPositions(positions_of(context))
        other.setVelocities(velocities_of(context))
        assert_same_run(used, context, fresh, other, steps=1)
        del other


@pytest.mark.parametrize("update", UPDATES)
def test_time_and_step_count_do_not_disturb(update: str, platform: str) -> None:
    """They are labels: the trajectory goes on to the last bit, without an evaluation of the forces."""
    model = chain()
    runs = []
    for relabel in (False, True):
        integrator = with_update(make_integrator(), update)
        context = open_context(model.system(), integrator, platform, model)
        if relabel:
            context.setTime(5.0)
            context.setStepCount(1000)
        for i in range(60):
            integrator.step(1)
            if relabel and i % 7 == 3:
                context.setTime(100.0 * i)
                context.setStepCount(10**10 + i)
        assert integrator.getNumForceEvaluations() == 61
        runs.append((positions_of(context), velocities_of(context), integrator.getStepDensity()))
        if relabel:
            # The last relabelling was at i = 59.
            assert context.getStepCount() == 10**10 + 59
            assert time_of(context) == 5900.0
            integrator.step(3)
            assert context.getStepCount() == 10**10 + 62
            # Rounding of a time of 5900 ps: 1e-12.
            assert 0.0003 < time_of(context) - 5900.0 < 0.003
            context.setTime(-1.0)
            integrator.stepTo(-0.99)
            assert time_of(context) == -0.99
    for plain, relabelled in zip(*runs, strict=True):
        assert np.array_equal(plain, relabelled)


@pytest.mark.parametrize("update", UPDATES)
def test_reading_does_not_disturb_a_box_with_a_neighbour_list(update: str) -> None:
    """getState of other groups, which leaves other forces in the Context's arrays, between the steps."""
    modeller, force_field = solvated(count=60)
    results = []
    system = smooth_cutoff(
        force_field.createSystem(modeller.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.55), 0.45
    )
    extra = openmm.CustomExternalForce("3*sin(4*x)")
    extra.addParticle(0, [])
    extra.setForceGroup(4)
    system.addForce(extra)
    positions, velocities = relax(system, modeller.positions, steps=50)
    for look in (False, True):
        integrator = with_update(make_integrator(0.001), update)
        context = open_context(system, integrator, fastest_platform())
        context.setPositions(positions)
        context.setVelocities(velocities)
        for _ in range(20):
            integrator.step(1)
            if look:
                context.getState(forces=True, energy=True, groups={4})
                context.getState(positions=True, velocities=True, forces=True, energy=True, parameters=True)
                context.getState(energy=True, groups=0)
        assert integrator.getNumForceEvaluations() == 21
        results.append((positions_of(context), velocities_of(context)))
    # One thread and forces summed in a fixed order; a neighbour list that is renewed at another step may still change
    # the order of a sum in single precision: 1e-7 of forces of 1e3 over 20 fs squared.
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(results[0][1], results[1][1], rtol=0, atol=1e-6)


def test_integration_force_groups_in_the_course_of_a_run(platform: str) -> None:
    """The groups may change between steps: forces and density are renewed, once."""
    model = chain()

    def create_system() -> openmm.System:
        system = model.system()
        extra = openmm.CustomExternalForce("100*(x+0.3)^2")
        for i in range(8):
            extra.addParticle(i, [])
        extra.setForceGroup(3)
        system.addForce(extra)
        return system

    used = make_integrator(setConstraintTolerance=1e-12)
    context = open_context(create_system(), used, platform, model)
    used.step(20)
    for groups in ({0}, {0, 3}):
        evaluations = used.getNumForceEvaluations()
        used.setIntegrationForceGroups(groups)
        q, v = positions_of(context), velocities_of(context)
        fresh = make_integrator(setConstraintTolerance=1e-12)
        fresh.setIntegrationForceGroups(groups)
        fresh.setReferenceMonitorValue(used.getReferenceMonitorValue())
        other = open_context(create_system(), fresh, platform)
        other.setPositions(q)
        other.setVelocities(v)
        assert_same_run(used, context, fresh, other, steps=20)
        assert used.getNumForceEvaluations() - evaluations <= 22
        # The same value once more is no change.
        evaluations = used.getNumForceEvaluations()
        used.setIntegrationForceGroups(groups)
        used.step(5)
        assert used.getNumForceEvaluations() == evaluations + 5
        del other


def test_a_force_added_to_a_group_before_a_reinitialisation(platform: str) -> None:
    model = chain()
    system = model.system()
    used = make_integrator(setConstraintTolerance=1e-12)
    context = open_context(system, used, platform, model)
    used.step(20)
    extra = openmm.CustomExternalForce("30*y*y")
    for i in range(8):
        extra.addParticle(i, [])
    extra.setForceGroup(7)
    system.addForce(extra)
    reference = used.getReferenceMonitorValue()
    context.reinitialize(preserveState=True)
    used.setReferenceMonitorValue(reference)
    fresh = make_integrator(setConstraintTolerance=1e-12)
    fresh.setReferenceMonitorValue(reference)
    other = open_context(system, fresh, platform)
    other.setPositions(positions_of(context))
    other.setVelocities(velocities_of(context))
    assert_same_run(used, context, fresh, other)
    without = make_integrator()
    third = open_context(model.system(), without, platform, model)
    without.step(50)
    assert np.max(np.abs(positions_of(third) - positions_of(context))) > 1e-5


@pytest.mark.parametrize("minimise_first", [True, False])
def test_minimisation_before_and_between_runs(minimise_first: bool, platform: str) -> None:
    """Each run conserves its own energy, and the first step after a minimisation is that of a new Context."""
    model = waters()
    system = model.system()
    integrator = make_integrator(0.0005, "ConstraintAndAppliedForce", setConstraintTolerance=1e-10)
    context = open_context(system, integrator, platform, model)
    if not minimise_first:
        integrator.step(50)
    reference = integrator.getReferenceMonitorValue()
    for round_ in range(3):
        before = value(context.getState(energy=True).getPotentialEnergy())
        openmm.LocalEnergyMinimizer.minimize(context, 1.0, 30)
        after = value(context.getState(energy=True).getPotentialEnergy())
        assert after < before - 1
        context.setVelocitiesToTemperature(100, 3 + round_)
        state = context.getState(positions=True, velocities=True, energy=True)
        start = value(state.getKineticEnergy()) + value(state.getPotentialEnergy())
        fresh = make_integrator(0.0005, "ConstraintAndAppliedForce", setConstraintTolerance=1e-10)
        fresh.setReferenceMonitorValue(reference)
        other = open_context(system, fresh, platform)
        other.setPositions(state.getPositions(asNumpy=True))
        other.setVelocities(state.getVelocities(asNumpy=True))
        # CPU: forces of single precision, summed in an order that depends on the neighbour list.
        assert_same_run(integrator, context, fresh, other, steps=10, atol=1e-9 if platform == "Reference" else 1e-6)
        reference = integrator.getReferenceMonitorValue()
        integrator.step(40)
        state = context.getState(energy=True)
        # Of a kinetic energy of 20 kJ/mol; with forces from before the minimisation it would be off by more than 1.
        assert abs(value(state.getKineticEnergy()) + value(state.getPotentialEnergy()) - start) < 0.05
        del other


def test_minimisation_keeps_the_constraints_and_the_settings() -> None:
    model = waters()
    integrator = make_integrator(0.0005, setConstraintTolerance=1e-9)
    context = open_context(model.system(), integrator, "Reference", model)
    openmm.LocalEnergyMinimizer.minimize(context, 1.0, 50)
    assert np.max(np.abs(model.constraints().relative_errors(positions_of(context).ravel()))) < 1e-7
    assert integrator.getReferenceMonitorValue() == 0
    assert integrator.getNumForceEvaluations() == 0
    assert value(integrator.getNominalStepSize()) == 0.0005
    assert integrator.getMonitor(0)[0] == VariableStepRattleIntegrator.ConstraintMultipliers


def test_new_velocities_have_the_temperature(platform: str) -> None:
    """setVelocitiesToTemperature: the velocities are on-step and satisfy the constraints, with their fewer freedoms."""
    model = waters(3)
    c = model.constraints()
    integrator = make_integrator()
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(2)
    kinetic = []
    for seed in range(1, 41):
        context.setVelocitiesToTemperature(300, seed)
        q, v = positions_of(context).ravel(), velocities_of(context).ravel()
        assert np.max(np.abs(c.jacobian(q) @ v)) < 1e-5  # OpenMM's own projection, to the tolerance it uses.
        kinetic.append(value(context.getState(energy=True).getKineticEnergy()))
        if seed < 4:
            integrator.step(1)
    freedoms = 27 * 6
    # 40 samples of 162 freedoms: standard error of sqrt(2/6480) = 1.8 %.
    assert np.mean(kinetic) * 2 / (freedoms * 0.00831446261815324) == pytest.approx(300, rel=0.07)


def test_changes_by_context_and_by_integrator_together() -> None:
    """New settings and a new state at once: as a new Context with both."""
    model = chain()
    used = make_integrator(setConstraintTolerance=1e-12)
    context = open_context(model.system(), used, "Reference", model)
    used.step(20)
    settings: dict[str, Any] = {
        "setMaximumStepSize": 0.0008,
        "setMinimumStepSize": 0.0001,
        "setNominalStepSize": 0.0004,
    }
    for name, setting in settings.items():
        getattr(used, name)(setting)
    context.setPositions(model.positions)
    context.setVelocities(0.5 * model.velocities)
    fresh = make_integrator(0.0004, setConstraintTolerance=1e-12, setMaximumStepSize=0.0008, setMinimumStepSize=0.0001)
    fresh.setReferenceMonitorValue(used.getReferenceMonitorValue())
    other = open_context(model.system(), fresh, "Reference", model)
    other.setVelocities(0.5 * model.velocities)
    assert_same_run(used, context, fresh, other)
