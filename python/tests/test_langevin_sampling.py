# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What VariableStepRattleLangevinIntegrator samples, against quadrature and theory.

Seeds are fixed. Errors are standard errors of the mean over independent copies, or over blocks of a run.
"""

from __future__ import annotations

import io
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
import pytest
from langevin_statement import BOLTZMANN
from openmm import app, unit
from openmmvrattle import VariableStepRattleLangevinIntegrator
from openmmvrattle.testsystems import rigid_waters
from project_scripts import load_script
from run_support import degrees_of_freedom, fastest_platform, relax, solvated

KT = 300 * BOLTZMANN
REFERENCE = openmm.Platform.getPlatform("Reference")


def open_context(
    system: openmm.System, positions: Any, step: float, friction: float, seed: int = 1, **settings: Any
) -> tuple[openmm.Context, VariableStepRattleLangevinIntegrator]:
    integrator = VariableStepRattleLangevinIntegrator(300, friction, step, randomNumberSeed=seed)
    for name, value in settings.items():
        getattr(integrator, name)(*value)
    context = openmm.Context(system, integrator, REFERENCE)
    context.setPositions(positions)
    context.setVelocitiesToTemperature(300, seed)
    return context, integrator


def positions_of(context: openmm.Context) -> np.ndarray:
    return context.getState(positions=True).getPositions(asNumpy=True)._value


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Of independent values."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def blocks(values: Any, count: int = 20) -> tuple[float, float]:
    """Of the values of a run, which are not independent."""
    values = np.array(values)
    values = values[len(values) % count :]
    return mean_and_error(values.reshape(count, -1).mean(axis=1))


def assert_agrees(what: str, measured: tuple[float, float], expected: float, largest: float, bias: float = 0) -> None:
    """Within four standard errors, and what the step is known to do, where these are small enough to tell."""
    mean, error = measured
    print(f"{what}: {mean:.5f} +- {error:.5f}, expected {expected:.5f}")
    assert error < largest * abs(expected), "the run is too short to tell"
    assert abs(mean - expected) < 4 * error + bias * abs(expected)


def quadrature(
    weight: Callable[[np.ndarray], np.ndarray], value: Callable[[np.ndarray], np.ndarray], low: float, high: float
) -> float:
    x = np.linspace(low, high, 20001)
    return float(np.sum(weight(x) * value(x)) / np.sum(weight(x)))


def test_marginals_of_potentials() -> None:
    """Along x harmonic with omega H = 1, along y quartic, along z a double well."""
    count, mass, step = 400, 10.0, 0.004
    length = 5 * step * np.sqrt(KT / mass)  # H is 0.2 in the units of kT, m and this, and 0.1 along z
    potential = openmm.CustomExternalForce("k*x^2/2 + kT*(y/length)^4 + 3*kT*((z/(2*length))^2-1)^2")
    for name, value in {"k": mass / step**2, "kT": KT, "length": length}.items():
        potential.addGlobalParameter(name, value)
    system = openmm.System()
    for i in range(count):
        system.addParticle(mass)
        potential.addParticle(i, [])
    system.addForce(potential)
    signs = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    positions = np.stack([np.zeros(count), np.zeros(count), signs * 2 * length], axis=1)
    context, integrator = open_context(system, positions, step, 30)
    integrator.step(1000)  # from rest, so that the reference has to rise by a factor of three
    substepped = integrator.getNumSubstepped()
    samples = []
    for _ in range(800):
        integrator.step(10)
        samples.append(positions_of(context))
    q = np.array(samples)
    x, y, z = q[:, :, 0] * np.sqrt(mass / KT) / step, q[:, :, 1] / length, q[:, :, 2] / (2 * length)

    def measured(values: np.ndarray) -> tuple[float, float]:
        return mean_and_error(values.mean(axis=0))

    assert_agrees("harmonic <x^2>", measured(x**2), 1.0, 0.004)
    assert_agrees("harmonic <x^4>", measured(x**4), 3.0, 0.01)

    def quartic(y: np.ndarray) -> np.ndarray:
        return np.exp(-(y**4))

    # At twice this step the square is 0.7 % too small, and the error goes with the square of the step.
    assert_agrees("quartic <y^2>", measured(y**2), quadrature(quartic, np.square, -4, 4), 0.005, bias=0.002)
    assert_agrees("quartic <y^4>", measured(y**4), 0.25, 0.005, bias=0.002)

    def well(z: np.ndarray) -> np.ndarray:
        return np.exp(-3 * (z * z - 1) ** 2)

    def is_on_top(z: np.ndarray) -> np.ndarray:
        return (np.abs(z) < 0.3).astype(float)

    assert_agrees("double well <z^2>", measured(z**2), quadrature(well, np.square, -4, 4), 0.005, bias=0.003)
    assert_agrees("double well P(top)", measured(is_on_top(z)), quadrature(well, is_on_top, -4, 4), 0.05, bias=0.03)
    assert integrator.getNumSubstepped() - substepped < 10


@pytest.mark.parametrize(("step", "friction"), [(0.002, 100), (0.004, 50)])
def test_temperature_of_rigid_water(step: float, friction: float) -> None:
    """Eight waters in a trap: within 0.5 % as reported, and lower in the velocities, at 4 fs by more than a percent."""
    waters = rigid_waters(8)
    system = waters.system
    trap = openmm.CustomExternalForce("20*(x^2+y^2+z^2)")
    for i in range(0, system.getNumParticles(), 3):
        trap.addParticle(i, [])
    system.addForce(trap)
    context, integrator = open_context(system, waters.positions, step, friction)
    integrator.step(2000)
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    reported, by_hand = [], []
    for _ in range(12000):
        integrator.step(5)
        state = context.getState(energy=True, velocities=True)
        v = state.getVelocities(asNumpy=True)._value
        for values, kinetic in (
            (reported, state.getKineticEnergy()._value),
            (by_hand, 0.5 * np.sum(masses * np.sum(v * v, axis=1))),
        ):
            values.append(2 * kinetic / (degrees_of_freedom(system) * BOLTZMANN))
    assert_agrees(f"temperature at {1000 * step:g} fs", blocks(reported), 300, 0.0025, bias=0.001)
    assert abs(np.mean(reported) - 300) < 0.005 * 300
    mean, error = blocks(by_hand)
    print(f"of the velocities {mean:.1f} +- {error:.1f}")
    assert step == 0.002 or mean + 4 * error < 299.5
    # An encounter takes up to some ten steps, and one in 60,000 steps is no surprise with eight waters in a trap.
    assert integrator.getNumSubstepped() <= 30


@pytest.mark.parametrize("samples", [2500, pytest.param(20000, marks=pytest.mark.claims)])
def test_temperature_along_and_across_constraints_by_expressions(samples: int) -> None:
    """Dumbbells and chains of ten without forces, whose bonds are expressions: within 0.5 %, in a long run."""
    system = openmm.System()
    positions: list[list[float]] = []
    bonds = []
    for copy in range(40):
        for i, mass in enumerate((12.0, 2.0)):
            system.addParticle(mass)
            positions.append([0.1 * i, 0.4 * copy, 0])
        bonds.append((2 * copy, 2 * copy + 1))
    for copy in range(10):
        for i in range(10):
            particle = system.addParticle(14.0 if i % 3 else 2.0)
            positions.append([0.09 * i, 0.04 * (i % 2), 1 + copy])
            if i > 0:
                bonds.append((particle - 1, particle))
    length = {"length": 0.1}
    integrator = VariableStepRattleLangevinIntegrator(300, 50, 0.004, randomNumberSeed=5)
    for bond in bonds:
        integrator.addConstraint("(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-length^2", bond, length)
    context = openmm.Context(system, integrator, REFERENCE)
    context.setPositions(positions)
    integrator.setVelocitiesToTemperature(300, 2)
    integrator.step(200)
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    first, second = np.array(bonds).T
    turning, moving, chains, all_of_it = [], [], [], []
    for _ in range(samples):
        integrator.step(5)
        state = context.getState(positions=True, velocities=True, energy=True)
        q, v = (x(asNumpy=True)._value for x in (state.getPositions, state.getVelocities))
        r, w = q[first] - q[second], v[first] - v[second]
        assert np.max(np.abs(np.sum(r * w, axis=1))) < 1e-8  # along
        assert np.max(np.abs(np.linalg.norm(r, axis=1) - 0.1)) < 1e-9
        reduced = 12 * 2 / 14
        turning.append(reduced * np.mean(np.sum(w[:40] ** 2, axis=1)) / (2 * KT))
        centre = (12 * v[0:80:2] + 2 * v[1:80:2]) / 14
        moving.append(14 * np.mean(centre**2) / KT)
        chains.append(np.sum(masses[80:, None] * v[80:] ** 2) / (10 * 21 * KT))
        all_of_it.append(state.getKineticEnergy()._value / (0.5 * KT * (40 * 5 + 10 * 21)))
    for what, values in (
        ("dumbbells across", turning),
        ("dumbbells, centre", moving),
        ("chains of ten", chains),
        ("kinetic energy", all_of_it),
    ):
        assert_agrees(what, blocks(values), 1, 0.005, bias=0.001)
        assert samples < 10000 or abs(np.mean(values) - 1) < 0.005


def test_angle_of_a_rigid_chain() -> None:
    """Three beads with a light one in the middle: p(cos) goes with the root of the metric determinant."""
    count, bond = 60, 0.1
    system = openmm.System()
    positions = []
    for copy in range(count):
        for i, mass in enumerate((14.0, 1.0, 14.0)):
            system.addParticle(mass)
            positions.append([bond * i, bond * (i == 2), copy])
            positions[-1][0] = bond * min(i, 1)
        for i in range(2):
            system.addConstraint(3 * copy + i, 3 * copy + i + 1, bond)
    context, integrator = open_context(system, positions, 0.004, 5, seed=3)
    integrator.step(500)
    cosines = []
    for _ in range(1200):
        integrator.step(10)
        q = positions_of(context).reshape(count, 3, 3)
        cosines.append(np.sum((q[:, 0] - q[:, 1]) * (q[:, 2] - q[:, 1]), axis=2 - 1) / bond**2)
    c = np.array(cosines)

    def weight(c: np.ndarray) -> np.ndarray:
        return np.sqrt((1 + 1 / 14) ** 2 - c**2)

    expected = quadrature(weight, np.square, -1, 1)
    assert abs(expected - 1 / 3) > 0.05  # which a wrong metric would give
    assert_agrees("<cos^2>", mean_and_error((c**2).mean(axis=0)), expected, 0.02)
    assert_agrees("1 + <cos>", mean_and_error(1 + c.mean(axis=0)), 1, 0.03)


@pytest.mark.parametrize("step", [0.004, 0.008])
def test_where_substeps_occur(step: float) -> None:
    """I-H-I with bonds of 0.16 nm whose ends repel each other: the light atom whips the chain through the collision."""
    count, bond, sigma, epsilon = 10, 0.16, 0.25, 4.0
    system = openmm.System()
    repulsion = openmm.CustomBondForce("step(2^(1/6)*sigma-r)*(4*epsilon*((sigma/r)^12-(sigma/r)^6)+epsilon)")
    repulsion.addGlobalParameter("sigma", sigma)
    repulsion.addGlobalParameter("epsilon", epsilon)
    positions = []
    for copy in range(count):
        for i, mass in enumerate((127.0, 1.0, 127.0)):
            system.addParticle(mass)
            positions.append([bond * i, 0.03 * (i == 1), copy])
        for i in range(2):
            system.addConstraint(3 * copy + i, 3 * copy + i + 1, bond)
        repulsion.addBond(3 * copy, 3 * copy + 2, [])
    system.addForce(repulsion)
    context, integrator = open_context(system, positions, step, 5, seed=3)
    integrator.step(500)
    cosines, energies = [], []
    evaluations, steps = integrator.getNumForceEvaluations(), 150000
    for _ in range(steps // 10):
        integrator.step(10)
        state = context.getState(positions=True, energy=True)
        q = state.getPositions(asNumpy=True)._value.reshape(count, 3, 3)
        cosines.append(np.mean(np.sum((q[:, 0] - q[:, 1]) * (q[:, 2] - q[:, 1]), axis=1)) / bond**2)
        energies.append(state.getPotentialEnergy()._value / (count * KT))
    evaluations = integrator.getNumForceEvaluations() - evaluations
    print(f"k > 0 in {integrator.getNumSubstepped()} of {steps} steps, {evaluations / steps:.3f} evaluations a step")

    def energy(c: np.ndarray) -> np.ndarray:
        sixth = (sigma / (bond * np.sqrt(2 - 2 * c))) ** 6
        return np.where(sixth > 0.5, 4 * epsilon * (sixth**2 - sixth) + epsilon, 0)

    def weight(c: np.ndarray) -> np.ndarray:
        return np.sqrt((1 + 1 / 127) ** 2 - c**2) * np.exp(-energy(c) / KT)

    low, high = -1, 0.5
    expected = quadrature(weight, lambda c: c, low, high)
    assert_agrees("<cos>", blocks(cosines), expected, 0.01, bias=0.005)
    expected = quadrature(weight, energy, low, high) / KT
    assert_agrees("<V>/kT", blocks(energies), expected, 0.02, bias=0.005)
    assert integrator.getNumSubstepped() > 20


TEMPERATURES = (300.0, 340.0, 390.0)


def oscillators(number: int = 20) -> tuple[app.Simulation, VariableStepRattleLangevinIntegrator]:
    """Particles in harmonic traps: the potential energy is 3/2 kT each."""
    system, topology = openmm.System(), app.Topology()
    trap = openmm.CustomExternalForce("500*(x^2+y^2+z^2)")
    residue = topology.addResidue("X", topology.addChain())
    for i in range(number):
        system.addParticle(10.0)
        topology.addAtom("X", app.Element.getBySymbol("C"), residue)
        trap.addParticle(i, [])
    system.addForce(trap)
    integrator = VariableStepRattleLangevinIntegrator(TEMPERATURES[0], 20, 0.02, randomNumberSeed=1)
    simulation = app.Simulation(topology, system, integrator, REFERENCE)
    simulation.context.setPositions(np.zeros((number, 3)))
    simulation.context.setVelocitiesToTemperature(TEMPERATURES[0], 1)
    random.seed(1)  # with which OpenMM's classes choose states
    return simulation, integrator


def assert_has_energies_of_temperatures(what: str, energies: list[list[float]], freedoms: int) -> None:
    for temperature, values in zip(TEMPERATURES, energies, strict=True):
        expected = 0.5 * freedoms * BOLTZMANN * temperature
        # Of values that are independent: the steps between two of them are longer than the friction takes.
        error = expected * np.sqrt(2 / freedoms / len(values))
        print(f"{what} at {temperature} K: {np.mean(values):.2f} +- {error:.2f}, expected {expected:.2f} kJ/mol")
        assert error < 0.02 * expected
        assert abs(np.mean(values) - expected) < 5 * error


@pytest.mark.parametrize("sampler", ["SimulatedTempering", "ExpandedEnsembleSampler"])
def test_one_run_at_many_temperatures(sampler: str) -> None:
    """With the right weights all temperatures are visited alike, and the energies at each are its own."""
    simulation, integrator = oscillators()
    freedoms, steps = 60, 6
    weights = [-0.5 * freedoms * np.log(t / TEMPERATURES[0]) for t in TEMPERATURES]
    if sampler == "SimulatedTempering":
        run = app.SimulatedTempering(
            simulation, temperatures=[t * unit.kelvin for t in TEMPERATURES], weights=weights,
            tempChangeInterval=steps, reportInterval=steps * 10**5, reportFile=io.StringIO(),
        )  # fmt: skip
    else:
        states = [{"temperature": t * unit.kelvin} for t in TEMPERATURES]
        run = app.ExpandedEnsembleSampler(
            states, simulation, steps, weights=weights, reportInterval=steps * 10**5, logFile=io.StringIO()
        )
    energies: list[list[float]] = [[] for _ in TEMPERATURES]
    for i in range(2000):
        run.step(steps)
        if i >= 20:
            energy = simulation.context.getState(energy=True).getPotentialEnergy()._value
            energies[TEMPERATURES.index(round(integrator.getTemperature()._value, 6))].append(energy)
    assert_has_energies_of_temperatures(sampler, energies, freedoms)
    assert all(abs(len(each) - 660) < 130 for each in energies)  # some hundred visits, of two or three steps each


def test_replica_exchange_samples_each_temperature() -> None:
    simulation, _ = oscillators()
    replicas = app.ReplicaExchangeSampler([{"temperature": t * unit.kelvin} for t in TEMPERATURES], simulation, 6)
    energies: list[list[float]] = [[] for _ in TEMPERATURES]
    states = set()

    def report(sampler: app.ReplicaExchangeSampler) -> None:
        states.add(tuple(sampler.replicaStateIndex))
        for replica, index in enumerate(sampler.replicaStateIndex):
            energies[index].append(sampler.replicaStateEnergy[replica][index]._value)

    replicas.simulate(20)
    replicas.reporters.append(report)
    replicas.simulate(500)
    assert_has_energies_of_temperatures("ReplicaExchangeSampler", energies, 60)
    assert len(states) == 6


def test_metadynamics_finds_a_free_energy() -> None:
    """Two wells, 5 kT deep: the bias of well-tempered metadynamics becomes what is known of the potential."""
    width, depth, mass = 0.1, 5 * KT, 10.0
    system, topology = openmm.System(), app.Topology()
    system.addParticle(mass)
    topology.addAtom("X", app.Element.getBySymbol("C"), topology.addResidue("X", topology.addChain()))
    wells = openmm.CustomExternalForce("depth*((x/width)^2-1)^2 + 500*(y^2+z^2)")
    wells.addGlobalParameter("depth", depth)
    wells.addGlobalParameter("width", width)
    wells.addParticle(0, [])
    system.addForce(wells)
    place = openmm.CustomExternalForce("x")
    place.addParticle(0, [])
    variable = app.BiasVariable(place, -2.5 * width, 2.5 * width, 0.15 * width, gridWidth=201)
    metadynamics = app.Metadynamics(system, [variable], 300, 6, 0.1 * KT, 20)
    integrator = VariableStepRattleLangevinIntegrator(300, 10, 0.01, randomNumberSeed=4)
    simulation = app.Simulation(topology, system, integrator, REFERENCE)
    simulation.context.setPositions([[width, 0, 0]])
    simulation.context.setVelocitiesToTemperature(300, 4)
    metadynamics.step(simulation, 120000)
    x = np.linspace(variable.minValue, variable.maxValue, variable.gridWidth)
    found = metadynamics.getFreeEnergy()._value / KT
    expected = depth * ((x / width) ** 2 - 1) ** 2 / KT
    near = np.abs(x) < 1.3 * width
    difference = (found - expected)[near]
    difference -= difference.mean()
    print(f"largest error of the free energy {np.abs(difference).max():.2f} kT, mean {difference.std():.2f} kT")
    assert difference.std() < 0.2
    assert np.abs(difference).max() < 0.5
    barrier = found[variable.gridWidth // 2] - found[near].min()
    assert barrier == pytest.approx(5, abs=0.5)


def dumbbells(number: int, spacing: float, repulsion: float) -> tuple[openmm.System, np.ndarray]:
    """A gas of rigid pairs of atoms that repel each other; or do not, and it is an ideal one."""
    system = openmm.System()
    force = openmm.CustomNonbondedForce("epsilon*(1-r/0.4)^2*step(0.4-r)")
    force.addGlobalParameter("epsilon", repulsion)
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.4)
    positions = []
    side = round(number ** (1 / 3))
    for k in np.ndindex(side, side, side):
        for end in range(2):
            system.addParticle(10.0)
            force.addParticle([])
            positions.append(spacing * np.array(k) + [0.1 * end, 0, 0])
        i = system.getNumParticles() - 2
        system.addConstraint(i, i + 1, 0.1)
        force.addExclusion(i, i + 1)
    system.addForce(force)
    edge = side * spacing
    system.setDefaultPeriodicBoxVectors([edge, 0, 0], [0, edge, 0], [0, 0, edge])
    return system, np.array(positions)


def volumes_at_constant_pressure(
    integrator: openmm.Integrator, system: openmm.System, positions: np.ndarray, pressure: float, count: int
) -> list[float]:
    """nm^3, at a pressure in kJ/mol/nm^3, after each of some attempts to change it."""
    to_bar = 16.60539  # 1 kJ/mol/nm^3
    barostat = openmm.MonteCarloBarostat(pressure * to_bar, 300, 2)
    barostat.setRandomNumberSeed(11)
    system.addForce(barostat)
    integrator.setRandomNumberSeed(12)
    context = openmm.Context(system, integrator, REFERENCE)
    context.setPositions(positions)
    context.setVelocitiesToTemperature(300, 13)
    integrator.step(2 * count // 10)
    volumes = []
    for _ in range(count):
        integrator.step(2)
        volumes.append(context.getState().getPeriodicBoxVolume()._value)
    return volumes


def test_volume_of_an_ideal_gas() -> None:
    """N rigid molecules that know nothing of each other: the mean volume is (N + 1) kT/P."""
    number, spacing = 27, 1.0
    system, positions = dumbbells(number, spacing, repulsion=0)
    pressure = (number + 1) * KT / (number * spacing**3)
    integrator = VariableStepRattleLangevinIntegrator(300, 5, 0.004)
    volumes = volumes_at_constant_pressure(integrator, system, positions, pressure, 5000)
    assert_agrees("volume", blocks(volumes), (number + 1) * KT / pressure, 0.02)
    spread = np.std(volumes) / (np.sqrt(number + 1) * KT / pressure)
    print(f"spread {spread:.3f} of what it should be")
    assert spread == pytest.approx(1, abs=0.1)


def test_volume_of_a_gas_is_that_of_openmm() -> None:
    """Molecules that repel each other, at a pressure where that counts for half of the volume."""
    number, spacing, results = 27, 0.45, []
    pressure = 2.5 * number * KT / (number * spacing**3)
    for integrator in (
        VariableStepRattleLangevinIntegrator(300, 5, 0.004),
        openmm.LangevinMiddleIntegrator(300, 5, 0.004),
    ):
        system, positions = dumbbells(number, spacing, repulsion=20)
        results.append(blocks(volumes_at_constant_pressure(integrator, system, positions, pressure, 3000)))
    (mine, error), (other, other_error) = results
    ideal = (number + 1) * KT / pressure
    print(
        f"{mine:.3f} +- {error:.3f}, LangevinMiddleIntegrator {other:.3f} +- {other_error:.3f}, ideal {ideal:.3f} nm^3"
    )
    assert np.hypot(error, other_error) < 0.015 * other
    assert abs(mine - other) < 4 * np.hypot(error, other_error)
    assert other > 1.3 * ideal


@pytest.mark.claims
@pytest.mark.parametrize(("count", "cutoff", "steps"), [(64, 0.55, 1_000_000), (216, 0.8, 50_000)])
def test_calm_water_has_no_substeps(count: int, cutoff: float, steps: int) -> None:
    """Boxes at 2 fs, the small one for two minutes; docs/langevin_benchmark.md has a million steps of the other."""
    modeller, force_field = solvated(count=count)
    system = force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=cutoff)
    positions, velocities = relax(system, modeller.positions, steps=2000)
    integrator = VariableStepRattleLangevinIntegrator(300, 1, 0.002, randomNumberSeed=6)
    platform = fastest_platform()
    threads = {"Threads": "1"} if platform == "CPU" else {}  # more would wait for each other
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(platform), threads)
    context.setPositions(positions.reshape(-1, 3))
    context.setVelocities(velocities.reshape(-1, 3))
    evaluations, largest = integrator.getNumForceEvaluations(), 0.0
    for _ in range(steps // 50):
        integrator.step(50)
        largest = max(largest, integrator.getMonitorValue() / integrator.getReferenceMonitorValue())
    print(f"{steps} steps, of which {integrator.getNumSubstepped()} have substeps; U up to {largest:.2f} U_ref seen")
    assert integrator.getNumSubstepped() == 0
    assert integrator.getNumForceEvaluations() - evaluations <= steps + 1


@pytest.mark.claims
@pytest.mark.parametrize("from_rest", [False, True])
def test_a_calm_peptide_takes_one_evaluation_a_step(from_rest: bool) -> None:
    """Alanine dipeptide in water, minimised, at 2 fs, the start included."""
    system, positions, _ = load_script("benchmarks/robustness.py").solvated_peptide(1)
    integrator = VariableStepRattleLangevinIntegrator(300, 1, 0.002, randomNumberSeed=6)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(fastest_platform()))
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context)
    context.setVelocitiesToTemperature(0 if from_rest else 300, 6)
    integrator.step(1)
    evaluations, steps = integrator.getNumForceEvaluations(), 6000
    integrator.step(steps)
    each = (integrator.getNumForceEvaluations() - evaluations) / steps
    print(f"{each:.5f} evaluations a step, {integrator.getNumSubstepped()} steps with substeps")
    assert each <= 1.001


@pytest.mark.claims
@pytest.mark.parametrize("step", [0.002, 0.004])
def test_potential_energy_of_water_is_that_of_openmm(step: float) -> None:
    """32 waters: the means of runs of both integrators at the same step differ by no more than their errors."""
    modeller, force_field = solvated(count=32)
    system = force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.45)
    positions, _ = relax(system, modeller.positions)
    results = []
    for integrator in (
        VariableStepRattleLangevinIntegrator(300, 10, step, randomNumberSeed=8),
        openmm.LangevinMiddleIntegrator(300, 10, step),
    ):
        integrator.setRandomNumberSeed(8)
        integrator.setConstraintTolerance(1e-8)
        context = openmm.Context(system, integrator, REFERENCE)
        context.setPositions(positions.reshape(-1, 3))
        context.setVelocitiesToTemperature(300, 8)
        integrator.step(round(20 / step))
        energies = []
        for _ in range(round(400 / step) // 25):
            integrator.step(25)
            energies.append(context.getState(energy=True).getPotentialEnergy()._value)
        results.append(blocks(energies, 40))
    (mine, error), (other, other_error) = results
    print(f"{step} ps: {mine:.1f} +- {error:.1f}, LangevinMiddleIntegrator {other:.1f} +- {other_error:.1f} kJ/mol")
    assert abs(mine - other) < 4 * np.hypot(error, other_error)
    assert np.hypot(error, other_error) < 0.01 * abs(other)
