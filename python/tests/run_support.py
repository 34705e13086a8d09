# OpenMM-VRATTLE: integrators, systems and runs that several files of tests share.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import Array, energy_of, positions_of, value, velocities_of
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import constraint_error

PRESENT = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
# A real GPU where there is one, or else OpenCL on the processor.
GPU = next((name for name in ("CUDA", "HIP", "OpenCL") if name in PRESENT), "OpenCL")
needs_gpu = pytest.mark.skipif(GPU not in PRESENT, reason="this OpenMM has no GPU platform")
BOLTZMANN = 0.00831446261815324
FORCE_MONITOR = "ConstraintAndAppliedForce"


def make_integrator(step: float = 0.0005, kind: str | None = None, **settings: Any) -> VariableStepRattleIntegrator:
    """An integrator with one monitor, the default one or of a kind; settings are names of setters and arguments."""
    integrator = VariableStepRattleIntegrator(step)
    if kind is not None:
        integrator.clearMonitors()
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, kind))
    for name, setting in settings.items():
        getattr(integrator, name)(setting)
    return integrator


def with_update(integrator: VariableStepRattleIntegrator, update: str) -> VariableStepRattleIntegrator:
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    return integrator


def add_thermostat_and_trap(system: openmm.System, frequency: float) -> None:
    """For waters(): 300 K, and a soft trap, out of which two walls of vapour cannot fly."""
    thermostat = openmm.AndersenThermostat(300, frequency)
    thermostat.setRandomNumberSeed(8)
    system.addForce(thermostat)
    trap = openmm.CustomExternalForce("50*((x-0.15)^2+(y-0.15)^2+(z-0.15)^2)")
    for i in range(0, 24, 3):
        trap.addParticle(i, [])
    system.addForce(trap)


def fastest_platform() -> str:
    """CPU where there is one: for tests too slow on Reference."""
    return "CPU" if "CPU" in PRESENT else "Reference"


def solvated(model: str = "tip3p", count: int = 60, shape: str = "cube") -> tuple[app.Modeller, app.ForceField]:
    """A periodic box of water, as it comes from OpenMM's Modeller."""
    force_field = app.ForceField({"tip3p": "tip3p.xml", "tip4pew": "tip4pew.xml"}[model])
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(force_field, model=model, numAdded=count, boxShape=shape)
    return modeller, force_field


def smooth_cutoff(system: openmm.System, distance: float) -> openmm.System:
    """Let the Lennard-Jones energy fade out from this distance on, so that no cutoff spoils the energy."""
    for force in system.getForces():
        if isinstance(force, openmm.NonbondedForce):
            force.setUseSwitchingFunction(True)
            force.setSwitchingDistance(distance)
    return system


def relax(system: openmm.System, positions: Any, temperature: float = 300.0, steps: int = 200) -> tuple[Array, Array]:
    """Positions and velocities after a minimisation and a little Langevin dynamics with OpenMM's own integrator."""
    integrator = openmm.LangevinMiddleIntegrator(temperature, 20, 0.001)
    integrator.setRandomNumberSeed(5)
    integrator.setConstraintTolerance(1e-8)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(fastest_platform()))
    context.setPositions(positions)
    context.computeVirtualSites()
    openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
    context.setVelocitiesToTemperature(temperature, 6)
    integrator.step(steps)
    return positions_of(context), velocities_of(context)


def degrees_of_freedom(system: openmm.System) -> int:
    moving = sum(value(system.getParticleMass(i)) > 0 for i in range(system.getNumParticles()))
    return 3 * moving - system.getNumConstraints()


def temperature_of(context: openmm.Context) -> float:
    kinetic = value(context.getState(energy=True).getKineticEnergy())
    return 2 * kinetic / (degrees_of_freedom(context.getSystem()) * BOLTZMANN)


def largest_energy_error(context: openmm.Context, integrator: Any, steps: int, every: int = 1) -> float:
    """Step, check that constraints hold, and return the largest distance of the energy from its value at the start."""
    start = energy_of(context)
    worst = 0.0
    for _ in range(steps // every):
        integrator.step(every)
        worst = max(worst, abs(energy_of(context) - start))
        # Rounding of |r|: positions up to 5 nm from the origin against bonds of 0.1 nm.
        assert (
            constraint_error(context.getSystem(), positions_of(context)) <= integrator.getConstraintTolerance() + 1e-13
        )
    return worst


def assert_same_run(
    used: VariableStepRattleIntegrator,
    context: openmm.Context,
    fresh: VariableStepRattleIntegrator,
    other: openmm.Context,
    steps: int = 30,
    atol: float = 1e-10,
) -> None:
    """Both go on alike: step density, positions and velocities after each step."""
    for _ in range(steps):
        used.step(1)
        fresh.step(1)
        # Solvers that may start from different guesses and stop at 1e-12, and the growth of that along the run.
        np.testing.assert_allclose(used.getStepDensity(), fresh.getStepDensity(), rtol=max(1e-9, atol))
        np.testing.assert_allclose(positions_of(context), positions_of(other), rtol=0, atol=atol)
        np.testing.assert_allclose(velocities_of(context), velocities_of(other), rtol=0, atol=100 * atol)


def rattle_as_custom_integrator(step: float) -> openmm.CustomIntegrator:
    """Velocity Verlet with constraints as in OpenMM's own documentation of CustomIntegrator."""
    integrator = openmm.CustomIntegrator(step)
    integrator.addPerDofVariable("x1", 0)
    integrator.addUpdateContextState()
    integrator.addComputePerDof("v", "v+0.5*dt*f/m")
    integrator.addComputePerDof("x", "x+dt*v")
    integrator.addComputePerDof("x1", "x")
    integrator.addConstrainPositions()
    integrator.addComputePerDof("v", "v+0.5*dt*f/m+(x-x1)/dt")
    integrator.addConstrainVelocities()
    integrator.setConstraintTolerance(1e-12)
    return integrator
