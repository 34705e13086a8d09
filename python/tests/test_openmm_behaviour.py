# OpenMM-VRATTLE: the integrator does what OpenMM's users expect of an integrator.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import (
    UPDATES,
    Model,
    chain,
    energy_of,
    open_context,
    positions_of,
    time_of,
    value,
    velocities_of,
    waters,
)
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator
from run_support import (
    BOLTZMANN,
    add_thermostat_and_trap,
    fastest_platform,
    make_integrator,
    rattle_as_custom_integrator,
)


@pytest.fixture(scope="module")
def water_box() -> tuple[app.Topology, Any, app.ForceField]:
    """A small box of TIP3P water, relaxed and then heated by OpenMM's own integrators."""
    force_field = app.ForceField("tip3p.xml")
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(force_field, model="tip3p", boxSize=openmm.Vec3(1.5, 1.5, 1.5))
    system = force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.7)
    integrator = openmm.LangevinMiddleIntegrator(300, 10, 0.002)
    integrator.setRandomNumberSeed(5)
    platform = fastest_platform()
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
    context.setPositions(modeller.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(300, 6)
    integrator.step(500)
    return modeller.topology, positions_of(context), force_field


@pytest.mark.parametrize("method", [app.CutoffPeriodic, app.PME])
def test_periodic_water(water_box: tuple[Any, Any, Any], method: Any, platform: str) -> None:
    topology, positions, force_field = water_box
    system = force_field.createSystem(topology, nonbondedMethod=method, nonbondedCutoff=0.7, removeCMMotion=False)
    for force in system.getForces():
        if isinstance(force, openmm.NonbondedForce):
            # Without it the cutoff itself spoils the energy.
            force.setUseSwitchingFunction(True)
            force.setSwitchingDistance(0.55)
    steps = 100 if platform == "Reference" else 300
    drifts = []
    for variable in (True, False):
        integrator = make_integrator(0.001, "ConstraintAndAppliedForce")
        if not variable:
            integrator.clearMonitors()
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
        context.setPositions(positions)
        context.applyConstraints(1e-8)
        context.setVelocitiesToTemperature(300, 3)
        state = context.getState(energy=True)
        kinetic = state.getKineticEnergy()._value
        start = kinetic + state.getPotentialEnergy()._value
        worst, sizes = 0.0, []
        for _ in range(steps // 5):
            integrator.step(5)
            sizes.append(value(integrator.getStepSize()))
            worst = max(worst, abs(energy_of(context) - start))
        assert integrator.getNumForceEvaluations() == steps + 1
        assert (max(sizes) > min(sizes)) == variable
        drifts.append(worst / kinetic)
        del context
    print(f"{method} on {platform}: energy error / kinetic energy: variable {drifts[0]:.2e}, fixed {drifts[1]:.2e}")
    # 1 fs for water: oscillations of the energy stay below a hundredth of the kinetic energy, which itself fluctuates
    # by a tenth; and variable steps are not for thermal liquids, but do no harm there either.
    assert drifts[0] < 0.01
    assert drifts[0] < 3 * drifts[1]


def test_massless_particle_stays(platform: str) -> None:
    model = chain()
    system = model.system()
    anchor = system.addParticle(0.0)
    bond = openmm.HarmonicBondForce()
    bond.addBond(0, anchor, 0.3, 500.0)
    system.addForce(bond)
    integrator = make_integrator()
    context = open_context(system, integrator, platform)
    place = [0.1, -0.3, 0.2]
    context.setPositions(np.concatenate([model.positions, [place]]))
    context.setVelocities(np.concatenate([model.velocities, [[0, 0, 0]]]))
    start = energy_of(context)
    integrator.step(300)
    assert np.array_equal(positions_of(context)[anchor], place)
    assert np.array_equal(velocities_of(context)[anchor], [0, 0, 0])
    moved = positions_of(context)
    # Its force acts: without it the chain is elsewhere.
    other = make_integrator()
    free = open_context(model.system(), other, platform, model)
    other.stepTo(time_of(context))
    assert np.max(np.abs(positions_of(free) - moved[:8])) > 1e-3
    assert abs(energy_of(context) - start) < 0.05  # of a kinetic energy of 20 kJ/mol


@pytest.mark.parametrize("update", UPDATES)
def test_virtual_sites(update: str, platform: str) -> None:
    """Four-site water: the charge sits on a site between the atoms, and its force goes to them."""
    model = waters()
    system = openmm.System()
    force = openmm.NonbondedForce()
    positions, velocities, sites = [], [], []
    for first in range(0, len(model.masses), 3):
        for k in range(3):
            system.addParticle(float(model.masses[first + k]))
        site = system.addParticle(0.0)
        sites.append(site)
        system.setVirtualSite(site, openmm.ThreeParticleAverageSite(site - 3, site - 2, site - 1, 0.786, 0.107, 0.107))
        system.addConstraint(site - 3, site - 2, float(model.lengths[0]))
        system.addConstraint(site - 3, site - 1, float(model.lengths[1]))
        system.addConstraint(site - 2, site - 1, float(model.lengths[2]))
        for charge, sigma, epsilon in ((0, 0.3164, 0.68), (0.52422, 1, 0), (0.52422, 1, 0), (-1.04844, 1, 0)):
            force.addParticle(charge, sigma, epsilon)
        for i in range(site - 3, site + 1):
            for j in range(i + 1, site + 1):
                force.addException(i, j, 0, 1, 0)
        positions += [*model.positions[first : first + 3], np.zeros(3)]
        velocities += [*model.velocities[first : first + 3], np.zeros(3)]
    system.addForce(force)
    integrator = make_integrator(0.0005, "ConstraintAndAppliedForce")
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    context = open_context(system, integrator, platform)
    context.setPositions(positions)
    context.computeVirtualSites()
    context.setVelocities(velocities)
    start = energy_of(context)
    worst = 0.0
    for _ in range(200):
        integrator.step(1)
        q = positions_of(context)
        for site in sites:
            expected = 0.786 * q[site - 3] + 0.107 * q[site - 2] + 0.107 * q[site - 1]
            np.testing.assert_allclose(q[site], expected, rtol=0, atol=1e-14)  # Rounding.
        worst = max(worst, abs(energy_of(context) - start))
    # With sites one step behind, or their forces lost, it would be off by more than the kinetic energy of 50 kJ/mol.
    print(f"virtual sites: largest energy error {worst:.2e} kJ/mol")
    assert worst < 0.5


def test_integration_force_groups(platform: str) -> None:
    """A group left out of the integration acts as if it were not there, but counts in the State's energy."""
    model = chain()
    system = model.system()
    extra = openmm.CustomExternalForce("100*(x+0.3)^2")
    for i in range(8):
        extra.addParticle(i, [])
    extra.setForceGroup(3)
    system.addForce(extra)
    left_out, without, with_it = make_integrator(), make_integrator(), make_integrator()
    left_out.setIntegrationForceGroups({0})
    contexts = [
        open_context(system, left_out, platform, model),
        open_context(model.system(), without, platform, model),
        open_context(system, with_it, platform, model),
    ]
    for integrator in (left_out, without, with_it):
        integrator.step(200)
    results = [positions_of(context) for context in contexts]
    assert np.array_equal(results[0], results[1])
    assert np.max(np.abs(results[0] - results[2])) > 1e-4
    assert value(contexts[0].getState(energy=True, groups={3}).getPotentialEnergy()) > 0.1


def test_centre_of_mass_motion_remover(platform: str) -> None:
    model = chain()
    runs = []
    for remove in (True, False):
        system = model.system()
        if remove:
            system.addForce(openmm.CMMotionRemover(1))
        integrator = make_integrator(setConstraintTolerance=1e-12)
        context = open_context(system, integrator, platform, model)
        integrator.step(200)
        runs.append((positions_of(context), model.masses @ velocities_of(context)))
    # There is nothing to remove but rounding, so the trajectory is the same but for the growth of rounding.
    np.testing.assert_allclose(runs[0][0], runs[1][0], rtol=0, atol=1e-9)
    assert np.max(np.abs(runs[0][1])) < 1e-10
    # And where there is something it is removed, also from the momenta that the integrator keeps for itself.
    system = model.system()
    system.addForce(openmm.CMMotionRemover(1))
    integrator = make_integrator()
    context = open_context(system, integrator, platform, model)
    context.setVelocities(model.velocities + np.array([0.5, -0.3, 0.2]))
    centre = model.masses @ model.positions / np.sum(model.masses)
    integrator.step(200)
    momentum = model.masses @ velocities_of(context)
    assert np.max(np.abs(momentum)) < 1e-3 * 0.5 * np.sum(model.masses)
    # Left alone it would have gone 0.05 nm.
    assert np.max(np.abs(model.masses @ positions_of(context) / np.sum(model.masses) - centre)) < 1e-3


def test_barostat(water_box: tuple[Any, Any, Any]) -> None:
    platform = fastest_platform()
    topology, positions, force_field = water_box
    # High pressure, so that the volume goes down beyond doubt.
    system = force_field.createSystem(topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.6)
    barostat = openmm.MonteCarloBarostat(20000, 300, 2)
    barostat.setRandomNumberSeed(4)
    system.addForce(barostat)
    integrator = make_integrator(0.001, "ConstraintAndAppliedForce")
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
    context.setPositions(positions)
    context.applyConstraints(1e-8)
    context.setVelocitiesToTemperature(300, 3)
    before = context.getState().getPeriodicBoxVolume()._value
    for _ in range(10):
        integrator.step(20)
        q = positions_of(context)
        for k in range(system.getNumConstraints()):
            i, j, distance = system.getConstraintParameters(k)
            assert abs(np.linalg.norm(q[i] - q[j]) / distance._value - 1) <= 1e-8 + 1e-14
    after = context.getState().getPeriodicBoxVolume()._value
    assert after < 0.98 * before
    assert np.all(np.isfinite(velocities_of(context)))


@pytest.mark.parametrize("update", UPDATES)
def test_andersen_thermostat(update: str, platform: str) -> None:
    """From rest to 300 K: the velocities that the thermostat sets are those that the integrator goes on with."""
    model = waters()
    system = model.system()
    add_thermostat_and_trap(system, 20)
    integrator = make_integrator(0.001, "ConstraintAndAppliedForce")
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    context = open_context(system, integrator, platform, model)
    context.setVelocities(np.zeros((24, 3)))
    c = model.constraints()
    integrator.step(1000)
    temperatures = []
    for _ in range(100):
        integrator.step(20)
        temperatures.append(2 * value(context.getState(energy=True).getKineticEnergy()) / (48 * BOLTZMANN))
        q, v = positions_of(context).ravel(), velocities_of(context).ravel()
        assert np.max(np.abs(c.jacobian(q) @ v)) < 1e-8
        assert np.max(np.abs(c.relative_errors(q))) <= 1e-8 + 1e-14
    mean = float(np.mean(temperatures))
    print(f"temperature {mean:.0f} K")
    # 48 degrees of freedom: one sample has a standard deviation of 61 K; 100 samples over 2 ps or 40 collision times
    # bring that to about 10 K.
    assert 240 < mean < 360


@pytest.mark.parametrize("update", UPDATES)
def test_looking_does_not_disturb(update: str) -> None:
    """Everything that can be read between steps leaves the trajectory alone to the last bit."""
    model = chain()
    results = []
    for look in (False, True):
        system = model.system()
        system.getForce(1).setForceGroup(2)
        integrator = make_integrator()
        integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
        context = open_context(system, integrator, "Reference", model)
        for _ in range(100):
            integrator.step(1)
            if look:
                context.getState(positions=True, velocities=True, forces=True, energy=True, groups={2})
                context.getState(energy=True, groups={0})
                integrator.getMultipliers()
                integrator.getMonitorValue()
                integrator.getStepSize()
                integrator.getReferenceMonitorValue()
        results.append((positions_of(context), velocities_of(context), time_of(context)))
    for alone, looked_at in zip(*results, strict=True):
        assert np.array_equal(alone, looked_at)


def test_looking_before_the_first_step_does_not_disturb() -> None:
    """What is read belongs to the state as it is; even one that does not satisfy the constraints is left as it is."""
    model = chain()
    positions = np.round(model.positions, 4)
    velocities = model.velocities + np.array([[0.01 * i, 0, 0] for i in range(8)])
    integrator = make_integrator()
    context = open_context(model.system(), integrator, "Reference")
    context.setPositions(positions)
    context.setVelocities(velocities)
    for read in (integrator.getMultipliers, integrator.getMonitorValue, integrator.getReferenceMonitorValue):
        read()
        assert np.array_equal(positions_of(context), positions)
        assert np.array_equal(velocities_of(context), velocities)
    assert time_of(context) == 0


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("change", ["positions", "velocities", "both"])
def test_new_state_in_the_middle_of_a_run(change: str, update: str) -> None:
    """After setPositions or setVelocities the run goes on as a new Context would in that state."""
    model = chain()
    used = make_integrator(setConstraintTolerance=1e-12)
    used.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    context = open_context(model.system(), used, "Reference", model)
    used.step(50)
    q, v = positions_of(context), velocities_of(context)
    if change == "positions":
        q = q + np.array([0.01, -0.02, 0.03])
        context.setPositions(q)
    elif change == "velocities":
        v = -0.7 * v
        context.setVelocities(v)
    else:
        q, v = model.positions, 1.3 * model.velocities
        context.setPositions(q)
        context.setVelocities(v)
    fresh = make_integrator(setConstraintTolerance=1e-12)
    fresh.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    fresh.setReferenceMonitorValue(used.getReferenceMonitorValue())
    other = open_context(model.system(), fresh, "Reference")
    other.setPositions(q)
    other.setVelocities(v)
    for _ in range(50):
        used.step(1)
        fresh.step(1)
        # Two solvers that may start from different guesses and stop at 1e-12, and the growth of that along 50 steps.
        assert used.getStepDensity() == pytest.approx(fresh.getStepDensity(), rel=1e-9)
        np.testing.assert_allclose(positions_of(context), positions_of(other), rtol=0, atol=1e-10)
        np.testing.assert_allclose(velocities_of(context), velocities_of(other), rtol=0, atol=1e-8)


@pytest.mark.parametrize("how", ["setParameter", "updateParametersInContext", "reinitialize"])
def test_forces_that_change_in_the_middle_of_a_run(how: str, platform: str) -> None:
    """The forces kept from the last step are out of date: the run goes on as with the new ones from here."""
    model = chain()

    def system_with(strength: float) -> tuple[Any, Any]:
        system = model.system()
        force = openmm.CustomExternalForce("strength*each*x")
        force.addGlobalParameter("strength", strength)
        force.addPerParticleParameter("each")
        for i in range(8):
            force.addParticle(i, [1.0])
        system.addForce(force)
        return system, force

    system, force = system_with(10.0)
    used = make_integrator(setConstraintTolerance=1e-12)
    context = open_context(system, used, platform, model)
    used.step(30)
    q, v = positions_of(context), velocities_of(context)
    if how == "setParameter":
        context.setParameter("strength", 300.0)
    else:
        for i in range(8):
            force.setParticleParameters(i, i, [30.0])
        if how == "updateParametersInContext":
            force.updateParametersInContext(context)
        else:
            context.reinitialize(preserveState=True)
    fresh = make_integrator(setConstraintTolerance=1e-12)
    fresh.setReferenceMonitorValue(used.getReferenceMonitorValue())
    other = open_context(system_with(300.0)[0], fresh, platform)
    other.setPositions(q)
    other.setVelocities(v)
    unchanged = make_integrator(setConstraintTolerance=1e-12)
    third = open_context(system_with(10.0)[0], unchanged, platform, model)
    unchanged.step(30)
    start = time_of(context)
    # The density may go on or start afresh, so compare at the same time; errors are of second order in steps of 0.5 fs,
    # and far below what the forces change.
    used.stepTo(start + 0.02)
    fresh.stepTo(0.02)
    unchanged.stepTo(start + 0.02)
    difference = np.max(np.abs(positions_of(context) - positions_of(other)))
    effect = np.max(np.abs(positions_of(context) - positions_of(third)))
    print(f"{how}: difference {difference:.1e}, effect of the change {effect:.1e}")
    assert effect > 1e-3
    assert difference < 2e-3 * effect


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("variable", [True, False])
def test_step_to(variable: bool, update: str, platform: str) -> None:
    model = chain()
    integrator = make_integrator()
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    if not variable:
        integrator.clearMonitors()
    context = open_context(model.system(), integrator, platform, model)
    start = energy_of(context)
    for target in (0.0301, 0.03010001, 0.0457, 0.1 / 3 * 2, 0.1):
        integrator.stepTo(target)
        assert time_of(context) == target
        here, evaluations = positions_of(context), integrator.getNumForceEvaluations()
        for earlier in (target, target / 2, 0.0, -1.0):
            integrator.stepTo(earlier)
        assert time_of(context) == target
        assert np.array_equal(positions_of(context), here)
        assert integrator.getNumForceEvaluations() == evaluations
        assert value(integrator.getStepSize()) <= 0.001
    integrator.stepTo(0.12 * unit.picoseconds)
    assert time_of(context) == 0.12
    integrator.step(1)
    # The density went on as it was: the next step has a full size again.
    assert 0.0002 < value(integrator.getStepSize()) < 0.001
    assert abs(energy_of(context) - start) < 0.05
    assert np.max(np.abs(model.constraints().relative_errors(positions_of(context).ravel()))) <= 1e-8


def test_no_steps_and_sizes_before_the_first(platform: str) -> None:
    model = chain()
    integrator = make_integrator(0.0007)
    assert value(integrator.getStepSize()) == value(integrator.getNominalStepSize()) == 0.0007
    assert unit.is_quantity(integrator.getStepSize())
    assert value(integrator.getMinimumStepSize()) == pytest.approx(0.0007 / 50, rel=1e-15)
    assert value(integrator.getMaximumStepSize()) == pytest.approx(0.0014, rel=1e-15)
    assert integrator.getStepDensity() == 1
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(0)
    assert time_of(context) == 0
    assert np.array_equal(positions_of(context), model.positions)
    assert np.array_equal(velocities_of(context), model.velocities)
    assert integrator.getReferenceMonitorValue() == 0
    assert value(integrator.getStepSize()) == 0.0007
    integrator.setStepSize(0.4 * unit.femtosecond)
    assert value(integrator.getNominalStepSize()) == pytest.approx(0.0004, rel=1e-15)
    assert value(integrator.getMaximumStepSize()) == pytest.approx(0.0008, rel=1e-15)
    integrator.step(1)
    assert time_of(context) == pytest.approx(0.0004, rel=1e-12)


def test_nominal_step_size_in_the_course_of_a_run(platform: str) -> None:
    """The density is kept, so the steps change in proportion."""
    model = chain()
    integrator = make_integrator(0.0004)
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(50)
    before = value(integrator.getStepSize())
    reference = integrator.getReferenceMonitorValue()
    integrator.setStepSize(0.0002)
    integrator.step(1)
    # Within one step of at most 1/10 of the time in which the density changes by itself.
    assert value(integrator.getStepSize()) == pytest.approx(before / 2, rel=0.1)
    assert integrator.getReferenceMonitorValue() == reference
    assert time_of(context) > 0


def test_calibrate(platform: str) -> None:
    """The mean of U over a run of plain RATTLE, after which the Context is as it was."""
    model = chain()
    plain = make_integrator(0.0005)
    plain.clearMonitors()
    context = open_context(model.system(), plain, platform, model)
    c = model.constraints()
    values = []
    for n in range(21):
        state = context.getState(positions=True, velocities=True, forces=True)
        q = state.getPositions(asNumpy=True)._value.ravel()
        p = c.m3 * state.getVelocities(asNumpy=True)._value.ravel()
        values.append(np.linalg.norm(c.multipliers(q, p, -state.getForces(asNumpy=True)._value.ravel())))
        if n < 20:
            plain.step(1)
    integrator = make_integrator(0.0005)
    other = open_context(model.system(), integrator, platform, model)
    integrator.calibrate(20)
    # The mean over the 20 states before, or after, or all 21: they differ by less than the spread over 20.
    mean = np.mean(values)
    assert integrator.getReferenceMonitorValue() == pytest.approx(mean, abs=(max(values) - min(values)) / 20)
    assert abs(mean - values[0]) > (max(values) - min(values)) / 20
    assert time_of(other) == 0
    assert np.array_equal(positions_of(other), model.positions)
    assert np.array_equal(velocities_of(other), model.velocities)
    integrator.step(1)
    # The first step is nominal only where U has the reference value, bounded by B with a = 1/2.
    u = values[0] / integrator.getReferenceMonitorValue()
    k = 0.5 / 49
    expected = 0.0005 / ((0.5 + 50 * k * u) / (1 + k * u))
    assert value(integrator.getStepSize()) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("make", [waters, chain])
def test_plain_rattle_is_openmms_velocity_verlet(make: Any, platform: str) -> None:
    model: Model = make()
    ours = make_integrator(0.001, setConstraintTolerance=1e-12)
    ours.clearMonitors()
    theirs = rattle_as_custom_integrator(0.001)
    context = open_context(model.system(), ours, platform, model)
    other = open_context(model.system(), theirs, platform, model)
    for _ in range(100):
        ours.step(1)
        theirs.step(1)
        # Both to 1e-12, and the growth of small errors along 0.1 ps. CPU computes nonbonded forces in single precision,
        # so that they change where positions do by rounding: by 1e-5 of the 500 nm/ps^2 of a hydrogen along 0.1 ps.
        atol = 1e-4 if platform == "CPU" and make is waters else 1e-9
        np.testing.assert_allclose(positions_of(context), positions_of(other), rtol=0, atol=atol)
        np.testing.assert_allclose(velocities_of(context), velocities_of(other), rtol=0, atol=100 * atol)
    assert np.max(np.abs(positions_of(context) - model.positions)) > 0.01


def test_simulation_and_reporters(platform: str) -> None:
    """The integrator in an app.Simulation, with a reporter that asks for the time and the temperature."""
    import io

    model = chain()
    topology = app.Topology()
    residue = topology.addResidue("CHN", topology.addChain())
    for i in range(8):
        topology.addAtom(f"C{i}", app.element.carbon, residue)
    integrator = make_integrator()
    simulation = app.Simulation(topology, model.system(), integrator, openmm.Platform.getPlatformByName(platform))
    simulation.context.setPositions(model.positions)
    simulation.context.setVelocities(model.velocities)
    output = io.StringIO()
    simulation.reporters.append(
        app.StateDataReporter(output, 10, step=True, time=True, totalEnergy=True, temperature=True)
    )
    simulation.step(50)
    lines = output.getvalue().splitlines()
    assert len(lines) == 6
    times = [float(line.split(",")[1]) for line in lines[1:]]
    assert times[-1] == pytest.approx(time_of(simulation.context), rel=1e-9)
    assert simulation.currentStep == 50
    energies = [float(line.split(",")[2]) for line in lines[1:]]
    assert max(energies) - min(energies) < 0.05
