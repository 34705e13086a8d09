# OpenMM-VRATTLE: forces that change the state: barostat, thermostat, centre of mass.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import numpy as np
import openmm
import pytest
from dense_reference import UPDATES, open_context, positions_of, time_of, value, velocities_of, waters
from openmm import app
from openmmvrattle.testsystems import constraint_error
from run_support import (
    BOLTZMANN,
    FORCE_MONITOR,
    add_thermostat_and_trap,
    degrees_of_freedom,
    fastest_platform,
    make_integrator,
    smooth_cutoff,
    solvated,
    with_update,
)


def test_water_at_constant_pressure() -> None:
    """From a box that is too large, at 0.87 g/ml, thermostat and barostat bring water to the density of TIP3P."""
    modeller, force_field = solvated(count=216)
    system = smooth_cutoff(
        force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.8), 0.7
    )
    thermostat = openmm.AndersenThermostat(300, 5)
    thermostat.setRandomNumberSeed(4)
    system.addForce(thermostat)
    barostat = openmm.MonteCarloBarostat(1.0, 300, 5)
    barostat.setRandomNumberSeed(5)
    system.addForce(barostat)
    integrator = make_integrator(0.002, FORCE_MONITOR)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(fastest_platform()))
    context.setPositions(modeller.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
    context.setVelocitiesToTemperature(300, 6)
    integrator.calibrate(20)
    mass = sum(value(system.getParticleMass(i)) for i in range(system.getNumParticles()))

    def density() -> float:
        return mass * 1.66053907e-3 / value(context.getState().getPeriodicBoxVolume())

    assert density() < 0.9
    densities, temperatures = [], []
    for i in range(100):
        integrator.step(20)
        assert constraint_error(system, positions_of(context)) <= 1e-8 + 1e-13
        if i >= 50:
            densities.append(density())
            kinetic = value(context.getState(energy=True).getKineticEnergy())
            temperatures.append(2 * kinetic / (degrees_of_freedom(system) * BOLTZMANN))
    mean, temperature = float(np.mean(densities)), float(np.mean(temperatures))
    print(f"density {mean:.3f} g/ml in {time_of(context):.1f} ps, temperature {temperature:.0f} K")
    assert len(set(densities)) > 10  # Moves are accepted.
    # 0.98 with TIP3P; 216 molecules and 2 ps leave a standard error of about 0.02.
    assert 0.92 < mean < 1.06
    # 1296 freedoms, some 5 independent samples: standard error 5 K; and 300 K are reached from the heat of contraction.
    assert 270 < temperature < 330
    assert integrator.getNumRescues() == 0


@pytest.mark.parametrize("update", UPDATES)
def test_temperature_holds(update: str) -> None:
    """Over 100 ps the time average of the temperature is the thermostat's to two parts in a hundred."""
    model = waters()
    system = model.system()
    add_thermostat_and_trap(system, 10)
    integrator = with_update(make_integrator(0.001, FORCE_MONITOR), update)
    context = open_context(system, integrator, "Reference", model)
    integrator.step(5000)
    kinetic, weights = [], []
    blocks, each = 20, 1000
    for _ in range(blocks * each):
        integrator.step(5)
        kinetic.append(value(context.getState(energy=True).getKineticEnergy()))
        # Steps are of different length: an average over time, not over steps.
        weights.append(value(integrator.getStepSize()))
    to_kelvin = 2 / (degrees_of_freedom(system) * BOLTZMANN)
    temperatures = to_kelvin * np.array(kinetic)
    mean = float(np.average(temperatures, weights=weights))
    means = [float(np.mean(temperatures[i * each : (i + 1) * each])) for i in range(blocks)]
    error = float(np.std(means)) / np.sqrt(blocks - 1)
    print(f"{update}: {time_of(context):.0f} ps, temperature {mean:.1f} K, standard error {error:.1f} K")
    # 61 K among samples of 48 freedoms, some 500 of them independent: a standard error near 3 K, known to a sixth.
    assert error < 6
    assert abs(mean - 300) < 4 * error
    # Fluctuations as in the canonical ensemble: variance of T is 2/48 T^2.
    assert np.std(temperatures) == pytest.approx(300 * np.sqrt(2 / 48), rel=0.15)
    assert integrator.getNumForceEvaluations() == 5001 + blocks * each * 5
    assert integrator.getNumRescues() == 0


def test_no_motion_of_the_centre(platform: str) -> None:
    """With a thermostat that gives the system momentum, and a remover that takes it away, every step."""
    model = waters()
    system = model.system()
    thermostat = openmm.AndersenThermostat(300, 50)
    thermostat.setRandomNumberSeed(2)
    system.addForce(thermostat)
    system.addForce(openmm.CMMotionRemover(1))
    integrator = make_integrator(0.001, FORCE_MONITOR)
    context = open_context(system, integrator, platform, model)
    centre = model.masses @ model.positions / np.sum(model.masses)
    largest = 0.0
    for _ in range(200):
        integrator.step(1)
        largest = max(largest, float(np.max(np.abs(model.masses @ velocities_of(context)))))
    # Removed before a step, and only rounding comes in the step: on CPU that of single-precision forces of 1e4 over
    # 1 fs; a collision of one molecule alone gives 18 amu * 0.4 nm/ps.
    assert largest < (1e-8 if platform == "Reference" else 1e-3)
    assert np.max(np.abs(model.masses @ positions_of(context) / np.sum(model.masses) - centre)) < 1e-5


def test_membrane_and_anisotropic_barostats() -> None:
    """The other barostats change the box as well, each in its own way."""
    modeller, force_field = solvated(count=60)
    platform = openmm.Platform.getPlatformByName(fastest_platform())
    barostats = [
        openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(5000, 5000, 5000), 300, True, True, True, 2),
        openmm.MonteCarloMembraneBarostat(
            5000, 0, 300, openmm.MonteCarloMembraneBarostat.XYIsotropic, openmm.MonteCarloMembraneBarostat.ZFree, 2
        ),
        openmm.MonteCarloFlexibleBarostat(5000, 300, 2),
    ]
    for barostat in barostats:
        barostat.setRandomNumberSeed(7)
        system = force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.5)
        system.addForce(barostat)
        integrator = make_integrator(0.001, FORCE_MONITOR)
        context = openmm.Context(system, integrator, platform)
        context.setPositions(modeller.positions)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 30)
        context.setVelocitiesToTemperature(300, 3)
        before = context.getState().getPeriodicBoxVectors(asNumpy=True)._value
        for _ in range(20):
            integrator.step(5)
            assert constraint_error(system, positions_of(context)) <= 1e-8 + 1e-13
        after = context.getState().getPeriodicBoxVectors(asNumpy=True)._value
        assert not np.array_equal(before, after), type(barostat)
        assert 0.7 < np.linalg.det(after) / np.linalg.det(before) < 1.1
        del context
