# OpenMM-VRATTLE: automatic step control against an independent statement, and what users rely on.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import (
    Array,
    Model,
    chain,
    double_pendulum,
    energy_of,
    open_context,
    pendulum_at,
    positions_of,
    time_of,
    value,
    velocities_of,
    waters,
    whip,
)
from openmmvrattle import VariableStepRattleIntegrator, XmlSerializer
from openmmvrattle.testsystems import TestSystem, alanine_dipeptide, light_heavy_chain, nitrogen_collision, rigid_waters
from project_scripts import load_script

ROOT = Path(__file__).parents[2]
LENGTH = 0.0125  # nm, of the product of force and squared speed


def automatic(step: float, calibration: int | None = None, tolerance: float = 1e-8) -> VariableStepRattleIntegrator:
    integrator = VariableStepRattleIntegrator(step, automatic=True, constraintTolerance=tolerance)
    if calibration is not None:
        integrator.useAutomaticStepControl(calibration)
    return integrator


def densities_of(integrator: VariableStepRattleIntegrator, steps: int) -> Array:
    result = []
    for _ in range(steps):
        integrator.step(1)
        result.append(integrator.getStepDensity())
    return np.array(result)


# ------------------------------------------------------------------------------------- the formulas, written once more


class Statement:
    """The monitors and the update of docs/automatic.md with dense matrices."""

    def __init__(self, model: Model) -> None:
        self.c = model.constraints()
        self.potential = model.potential()
        cluster = list(range(len(model.masses)))
        for i, j in model.pairs:
            old, new = cluster[j], cluster[i]
            cluster = [new if each == old else each for each in cluster]
        self.clusters = [[i for i, c in enumerate(cluster) if c == each] for each in sorted(set(cluster))]

    def forces(self, q: Array) -> Array:
        return -self.potential(q.ravel())[1].reshape(-1, 3)

    def squares(self, q: Array, v: Array) -> Array:
        """S_c from the constraint forces themselves."""
        force = self.forces(q)
        momenta = self.c.masses[:, None] * v
        multipliers = self.c.multipliers(q.ravel(), momenta.ravel(), -force.ravel())
        pull = (self.c.jacobian(q.ravel()).T @ multipliers).reshape(-1, 3)
        each = np.sum(pull**2 + force**2, axis=1) / self.c.masses
        return np.array([np.sum(each[c]) for c in self.clusters])

    def on_step(self, q: Array, v: Array) -> float:
        power = np.linalg.norm(self.forces(q), axis=1) * np.sum(v**2, axis=1) / LENGTH
        a = self.squares(q, v) + np.array([np.sum(power[c]) for c in self.clusters])
        return float(np.sum(a**4) ** (1 / 8))

    def half_step(self, q0: Array, v0: Array, q1: Array, v1: Array, size: float) -> float:
        rate = np.sum((q1 - q0) / size * (self.forces(q1) - self.forces(q0)), axis=1)
        b = 2 / size * np.abs([np.sum(rate[c]) for c in self.clusters])
        b = b + (self.squares(q0, v0) + self.squares(q1, v1)) / 2
        return float(np.sum(b**4) ** (1 / 8))


def f(x: float) -> float:
    return x - 0.75 - 1 / (16 * (x - 0.75))


def inverse(y: float) -> float:
    return 0.75 + (y + np.sqrt(y**2 + 0.25)) / 2


def target(u: float, reference: float, power: float) -> float:
    phi = (1 + ((u / reference) ** power / 2) ** 16) ** (1 / 16)
    return f(phi / (1 + (phi / 1000) ** 16) ** (1 / 16))


def density(a: float, b: float) -> float:
    return float(np.sqrt((inverse(a) ** 2 + inverse(b) ** 2) / 2))


def test_f_is_inverted() -> None:
    for x in (0.7500001, 0.8, 1, 3, 1e3):
        assert inverse(f(x)) == pytest.approx(x, rel=1e-12)


def trial_steps(model: Model, step: float, sign: float, steps: int) -> list[tuple[Array, Array]]:
    """Positions and velocities along steps of RATTLE, forwards or backwards in time."""
    integrator = VariableStepRattleIntegrator(step, monitors=[], constraintTolerance=1e-12)
    context = open_context(model.system(), integrator, "Reference", model)
    context.setVelocities(sign * model.velocities)
    states = [(model.positions, sign * model.velocities)]
    for _ in range(steps):
        integrator.step(1)
        states.append((positions_of(context), velocities_of(context)))
    return states


@pytest.mark.parametrize("make, step, range_of_steps", [(chain, 0.002, 1.5), (waters, 0.004, 1.4), (whip, 0.003, 1.3)])
def test_against_an_independent_statement(make: Callable[[], Model], step: float, range_of_steps: float) -> None:
    """Calibration, start, monitors and density of every step; and these steps are not all the same."""
    model, calibration = make(), 7
    statement = Statement(model)
    integrator = automatic(step, calibration, 1e-12)
    context = open_context(model.system(), integrator, "Reference", model)
    # The references: geometric means over fixed steps, from the start on.
    states = trial_steps(model, step, 1, calibration)
    on_step = [statement.on_step(*state) for state in states]
    half_step = [statement.half_step(*a, *b, step) for a, b in zip(states, states[1:], strict=False)]
    references = [float(np.exp(np.mean(np.log(each)))) for each in (on_step[1:], half_step)]
    for _ in range(2):  # Before and after the reference values are lowered, so that something happens.
        # The start: two steps backwards of the size of the first step.
        first = density(target(on_step[0], references[0], 2 / 3), target(0, references[1], 0.8))
        while True:
            back = trial_steps(model, step / first, -1, 2)
            on_back = [statement.on_step(*state) for state in back]
            half_back = [statement.half_step(*a, *b, step / first) for a, b in zip(back, back[1:], strict=False)]
            found = density(target(on_step[0], references[0], 2 / 3), target(half_back[0], references[1], 0.8))
            if found <= 1.1 * first:
                break
            first = found
        a0, a1, a2 = (target(u, references[0], 2 / 3) for u in on_back)
        b1, b3 = (target(u, references[1], 0.8) for u in half_back)
        last_a = (a0 + a1) / 2 - (a0 - 2 * a1 + a2) / 4
        last_a = min(max(last_a, min(a0, a1)), max(a0, a1))
        next_a, last_b, next_b = 2 * a0 - last_a, b1, 2 * b1 - b3
        context.setPositions(model.positions)
        context.setVelocities(model.velocities)
        q, v = model.positions, model.velocities
        densities = []
        for _ in range(60):
            integrator.step(1)
            size = value(integrator.getStepSize())
            assert integrator.getStepDensity() == pytest.approx(density(next_a, next_b), rel=1e-6)
            assert size == pytest.approx(step / integrator.getStepDensity(), rel=1e-12)
            densities.append(integrator.getStepDensity())
            new_q, new_v = positions_of(context), velocities_of(context)
            u_a, u_b = statement.on_step(new_q, new_v), statement.half_step(q, v, new_q, new_v, size)
            assert integrator.getMonitorValue(0) == pytest.approx(u_a, rel=1e-7)
            assert integrator.getMonitorValue(1) == pytest.approx(u_b, rel=1e-6)
            last_a, next_a = next_a, 2 * target(u_a, references[0], 2 / 3) - next_a
            last_b, next_b = next_b, 2 * target(u_b, references[1], 0.8) - last_b
            q, v = new_q, new_v
        for k in range(2):
            assert integrator.getReferenceMonitorValue(k) == pytest.approx(references[k], rel=1e-6)
            references[k] /= 10
            integrator.setReferenceMonitorValue(references[k], k)
    assert max(densities) / min(densities) > range_of_steps


def test_half_step_monitor_is_a_second_derivative() -> None:
    """On free particles without constraints, 2/dt w.(F1 - F0) is minus twice the change of V twice differentiated."""
    system = openmm.System()
    spring = openmm.CustomExternalForce("50*x^2+20*y^2+x*y*z")
    for mass in (1.0, 30.0):
        spring.addParticle(system.addParticle(mass))
    system.addForce(spring)
    model_q, model_v = np.array([[0.1, 0.2, 0.3], [0.3, -0.2, 0.1]]), np.array([[1.0, 2, 0.5], [0.3, 0.1, -0.4]])
    integrator = automatic(1e-5, 1)
    context = open_context(system, integrator, "Reference")
    context.setPositions(model_q)
    context.setVelocities(model_v)
    integrator.step(1)
    q, v = positions_of(context), velocities_of(context)
    b = []
    for (x, y, z), speed, mass in zip(q, v, (1.0, 30.0), strict=True):
        hessian = np.array([[100, z, y], [z, 40, x], [y, x, 0]])
        force = -np.array([100 * x + y * z, 40 * y + x * z, x * y])
        b.append(2 * abs(speed @ hessian @ speed) + force @ force / mass)
    assert integrator.getMonitorValue(1) == pytest.approx(np.sum(np.array(b) ** 4) ** (1 / 8), rel=1e-3)


# --------------------------------------------------------------------------------------- what makes the method


def model_of(test: TestSystem) -> Model:
    """A test system in the form of the models of these tests."""
    masses = np.array([value(test.system.getParticleMass(i)) for i in range(test.system.getNumParticles())])
    constraints = [test.system.getConstraintParameters(k) for k in range(test.system.getNumConstraints())]

    def forces(system: Any) -> None:
        for force in test.system.getForces():
            system.addForce(copy.deepcopy(force))

    pairs, lengths = [(i, j) for i, j, _ in constraints], np.array([value(length) for _, _, length in constraints])
    return Model(test.name, masses, pairs, lengths, test.positions, test.velocities, 0.001, forces)


def collision() -> Model:
    return model_of(nitrogen_collision(5.0))


def molecule() -> Model:
    return model_of(alanine_dipeptide())


# On CPU without nonbonded forces: those are of single precision there, and differ where positions differ by rounding.
@pytest.mark.parametrize(
    "make, step, least_ratio, platform",
    [
        (whip, 0.003, 30, "Reference"),
        (whip, 0.003, 30, "CPU"),
        (collision, 0.0006, 4, "Reference"),
        (molecule, 0.0005, 1, "Reference"),
    ],
)
def test_a_run_that_is_turned_round_comes_back(
    make: Callable[[], Model], step: float, least_ratio: float, platform: str
) -> None:
    model = make()
    integrator = automatic(step, 200, 1e-13)
    context = open_context(model.system(), integrator, platform, model)
    densities = densities_of(integrator, 1000)
    assert densities.max() / densities.min() >= least_ratio
    turning_point, evaluations = positions_of(context), integrator.getNumForceEvaluations()
    assert np.max(np.abs(turning_point - model.positions)) > 0.05
    integrator.reverse()
    assert integrator.getNumForceEvaluations() == evaluations
    back = densities_of(integrator, 1000)
    np.testing.assert_allclose(back[:-1], densities[:0:-1], rtol=1e-3)
    distance = float(np.max(np.abs(positions_of(context) - model.positions)))
    print(f"{model.name}, {platform}: {distance:.1e} nm, densities {densities.min():.3g} to {densities.max():.3g}")
    assert distance <= 1e-11


def test_second_order() -> None:
    """Against the continuous flow, on a double pendulum in the middle of a whip."""
    model, end = double_pendulum(1.0, 20.0), 1.8
    exact = pendulum_at(end, 1.0, 20.0)[0]
    steps, errors = np.array([0.004, 0.002, 0.001, 0.0005]), []
    for step in steps:
        integrator = automatic(step, tolerance=1e-12)
        for k in range(2):
            integrator.setReferenceMonitorValue(5.0, k)
        context = open_context(model.system(), integrator, "Reference", model)
        sizes = []
        while time_of(context) < 0.95 * end:
            integrator.step(1)
            sizes.append(value(integrator.getStepSize()))
        integrator.stepTo(end)
        assert time_of(context) == end
        assert max(sizes) / min(sizes) > 5
        errors.append(float(np.max(np.abs(positions_of(context) - exact))))
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    print("slope", slope, "errors", errors)
    assert 1.9 < slope < 2.1


@pytest.mark.parametrize("step", [0.001, 0.002])
def test_steps_stay_fixed_where_nothing_happens(step: float) -> None:
    """Thermal molecules are calm: steps are those of fixed steps to a few parts in a thousand."""
    for test in (rigid_waters(8), alanine_dipeptide()):
        integrator = automatic(step)
        context = open_context(test.system, integrator, "Reference", test)
        densities = densities_of(integrator, 5000)
        print(f"{test.name}: densities 1 - {1 - densities.min():.1e} to 1 + {densities.max() - 1:.1e}")
        assert np.max(np.abs(densities - 1)) < 0.01
        assert densities.mean() == pytest.approx(1, abs=1e-3)
        del context


def test_the_density_does_not_begin_to_oscillate() -> None:
    """At 2 fs the stiff angles of alanine dipeptide are hardly resolved: 10 steps to a period.

    With a dead zone that lets a little of their motion through, the undamped recursions pick it up, and within 50,000
    steps the oscillating steps had heated the molecule. Fixed steps keep its energy.
    """
    test = alanine_dipeptide()
    integrator = automatic(0.002)
    context = open_context(test.system, integrator, "Reference", test)
    energies = []
    for _ in range(2500):
        integrator.step(10)
        energies.append(energy_of(context))
        assert integrator.getStepDensity() == pytest.approx(1, abs=0.01)
    # The energy fluctuates by 0.4 kJ/mol about its mean; of 500 samples each, that has an error of 0.03.
    assert np.mean(energies[-500:]) == pytest.approx(np.mean(energies[:500]), abs=0.25)


def test_a_step_is_never_longer_than_four_thirds() -> None:
    test = light_heavy_chain(repulsion=True)
    integrator = automatic(0.0015)
    context = open_context(test.system, integrator, "Reference", test)
    densities = densities_of(integrator, 5000)
    assert densities.max() > 5
    assert densities.min() > 0.75
    assert integrator.getNumRescues() == 0
    del context


def test_it_pays_on_a_whip_and_costs_nothing_on_water() -> None:
    """Small versions of benchmarks/automatic.py, at equal steps."""

    def largest_error(test: Any, integrator: VariableStepRattleIntegrator, end: float) -> tuple[float, int]:
        context = open_context(test.system, integrator, "Reference", test)
        start, worst, steps = energy_of(context), 0.0, 0
        while time_of(context) < end:
            integrator.step(1)
            steps += 1
            worst = max(worst, abs(energy_of(context) - start))
        return worst, steps

    for test, end, step, least in ((light_heavy_chain(), 5.0, 0.00125, 100), (rigid_waters(8), 0.5, 0.001, 0.9)):
        ours, steps = largest_error(test, automatic(step), end)
        fixed, _ = largest_error(test, VariableStepRattleIntegrator(end / steps, monitors=[]), end)
        print(f"{test.name}: {steps} steps, gain {fixed / ours:.3g}")
        assert fixed / ours > least


# ------------------------------------------------------------------------------------------------ its cost and state


def counted(model: Model) -> tuple[openmm.System, list[int]]:
    """A system whose forces are counted by a force written in Python."""
    calls = [0]

    def count(state: Any) -> Any:
        calls[0] += 1
        return 0.0, np.zeros((len(model.masses), 3))

    system = model.system()
    system.addForce(openmm.PythonForce(count))
    return system, calls


def test_one_evaluation_a_step(platform: str) -> None:
    """After the start, which costs the calibration, two steps backwards and the forces themselves."""
    model = waters()
    system, calls = counted(model)
    integrator = automatic(0.001, 25)
    context = open_context(system, integrator, platform, model)
    state = context.getState(positions=True, velocities=True)
    calls[0] = 0
    integrator.step(1)
    assert calls[0] == 1 + 25 + 2 + 1 == integrator.getNumForceEvaluations()
    integrator.step(200)
    assert calls[0] == 29 + 200 == integrator.getNumForceEvaluations()
    # The calibration has left no trace: with its values given, the run is the same.
    other = automatic(0.001, 1000)
    for k in range(2):
        other.setReferenceMonitorValue(integrator.getReferenceMonitorValue(k), k)
    again = open_context(system, other, platform, model)
    assert np.array_equal(positions_of(again), state.getPositions(asNumpy=True)._value)
    other.step(201)
    np.testing.assert_array_equal(positions_of(again), positions_of(context))
    assert other.getNumForceEvaluations() == 1 + 2 + 201


def test_a_change_by_the_user_costs_the_start() -> None:
    """References stay; the densities start anew with two steps backwards, and forces at the new state."""
    model = waters()
    integrator = automatic(0.001, 25)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(5)
    references = [integrator.getReferenceMonitorValue(k) for k in range(2)]
    changes: list[Callable[[], Any]] = [
        lambda: context.setVelocities(velocities_of(context)),
        lambda: context.setPositions(positions_of(context)),
        lambda: context.setPeriodicBoxVectors([3, 0, 0], [0, 3, 0], [0, 0, 3]),
    ]
    for change in changes:
        change()
        before = integrator.getNumForceEvaluations()
        integrator.step(5)
        assert integrator.getNumForceEvaluations() == before + 1 + 2 + 5
        assert [integrator.getReferenceMonitorValue(k) for k in range(2)] == references
    integrator.useAutomaticStepControl(10)
    before = integrator.getNumForceEvaluations()
    integrator.step(5)
    assert integrator.getNumForceEvaluations() == before + 10 + 2 + 5
    assert [integrator.getReferenceMonitorValue(k) for k in range(2)] != references
    before = integrator.getNumForceEvaluations()
    integrator.calibrate(10)
    assert integrator.getNumForceEvaluations() == before + 10


def test_a_parameter_renews_the_forces() -> None:
    model = waters()
    system = model.system()
    trap = openmm.CustomExternalForce("k*(x^2+y^2+z^2)")
    trap.addGlobalParameter("k", 1.0)
    for i in range(len(model.masses)):
        trap.addParticle(i)
    system.addForce(trap)
    integrator = automatic(0.001, 25)
    context = open_context(system, integrator, "Reference", model)
    integrator.step(20)
    context.setParameter("k", 100.0)
    position, velocity = positions_of(context), velocities_of(context)
    integrator.step(20)
    fresh = automatic(0.001)
    for k in range(2):
        fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue(k), k)
    other = open_context(system, fresh, "Reference")
    other.setParameter("k", 100.0)
    other.setPositions(position)
    other.setVelocities(velocity)
    fresh.step(20)
    np.testing.assert_allclose(positions_of(context), positions_of(other), rtol=0, atol=1e-12)


@pytest.mark.parametrize("make, step", [(waters, 0.001), (whip, 0.003)])
def test_a_checkpoint_goes_on_to_the_last_bit(make: Callable[[], Model], step: float) -> None:
    model = make()
    integrator = automatic(step, 50)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(137)
    checkpoint = context.createCheckpoint()
    values = [integrator.getMonitorValue(k) for k in range(2)]
    expected = densities_of(integrator, 300)
    positions = positions_of(context)
    integrator.clearMonitors()  # The settings are part of the checkpoint.
    context.loadCheckpoint(checkpoint)
    assert integrator.isAutomatic()
    other = VariableStepRattleIntegrator(0.5)
    another = open_context(model.system(), other, "Reference")
    another.loadCheckpoint(checkpoint)
    for each, where in ((integrator, context), (other, another)):
        assert [each.getMonitorValue(k) for k in range(2)] == values
        np.testing.assert_array_equal(densities_of(each, 300), expected)
        np.testing.assert_array_equal(positions_of(where), positions)
    # Turned round right after a restart it comes back as well.
    another.loadCheckpoint(checkpoint)
    other.reverse()
    other.step(20)


def test_a_state_goes_on() -> None:
    model = waters()
    integrator = automatic(0.001, 50)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(137)
    state = context.getState(positions=True, velocities=True, integratorParameters=True)
    state = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(state))
    expected = densities_of(integrator, 100)
    other = VariableStepRattleIntegrator(0.5)
    another = open_context(model.system(), other, "Reference")
    another.setState(state)
    np.testing.assert_allclose(densities_of(other, 100), expected, rtol=1e-9)
    assert other.getNumForceEvaluations() <= 102  # No calibration, no start.
    np.testing.assert_allclose(positions_of(another), positions_of(context), rtol=0, atol=1e-9)


def test_settings_are_copied() -> None:
    integrator = automatic(0.001, 123)
    integrator.setReferenceMonitorValue(4.5, 0)
    integrator.setReferenceMonitorValue(5.5, 1)
    for other in (copy.deepcopy(integrator), XmlSerializer.deserialize(XmlSerializer.serialize(integrator))):
        assert other.isAutomatic()
        assert other.getCalibrationSteps() == 123
        assert [other.getReferenceMonitorValue(k) for k in range(2)] == [4.5, 5.5]
        assert other.getNumMonitors() == 0
    plain = XmlSerializer.deserialize(XmlSerializer.serialize(VariableStepRattleIntegrator(0.001)))
    assert not plain.isAutomatic()


def test_switching_off_and_on() -> None:
    model = waters()
    integrator = automatic(0.001, 20)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(50)
    integrator.clearMonitors()
    assert not integrator.isAutomatic()
    np.testing.assert_allclose(densities_of(integrator, 20), 1, rtol=1e-12)
    integrator.addMonitor(VariableStepRattleIntegrator.ConstraintAndAppliedForce)
    assert np.ptp(densities_of(integrator, 20)) > 1e-3
    integrator.useAutomaticStepControl(20)
    assert integrator.getNumMonitors() == 0
    energies = []
    for _ in range(200):
        integrator.step(1)
        energies.append(energy_of(context))
    assert np.ptp(energies) < 0.2
    # A new nominal step goes on without a start.
    before = integrator.getNumForceEvaluations()
    integrator.setStepSize(0.0005)
    integrator.step(10)
    assert value(integrator.getStepSize()) == pytest.approx(0.0005, rel=0.1)
    assert integrator.getNumForceEvaluations() == before + 10


# --------------------------------------------------------------------------------- Forces, stepTo, no constraints


def run_with(model: Model, add: Callable[[openmm.System], Any], steps: int) -> tuple[Array, Array, int]:
    system = model.system()
    add(system)
    integrator = automatic(0.001, 100)
    context = open_context(system, integrator, "Reference", model)
    densities, temperatures = [], []
    for _ in range(steps):
        integrator.step(1)
        densities.append(integrator.getStepDensity())
        temperatures.append(2 * value(context.getState(energy=True).getKineticEnergy()) / 48 / 0.00831446261815324)
    return np.array(densities), np.array(temperatures), integrator.getNumForceEvaluations()


def test_a_thermostat_does_not_make_it_slower() -> None:
    """Collisions change velocities every few steps: no force is computed again, and no oscillation is left behind."""

    def andersen(system: openmm.System) -> None:
        thermostat = openmm.AndersenThermostat(300, 10)
        thermostat.setRandomNumberSeed(3)
        system.addForce(thermostat)

    densities, temperatures, evaluations = run_with(waters(), andersen, 5000)
    print(f"mean density {densities.mean():.4f}, largest {densities.max():.3f}, {temperatures[1000:].mean():.0f} K")
    assert evaluations == 103 + 5000
    assert np.abs(densities - 1).max() < 0.01
    # 48 freedoms, about 80 independent samples.
    assert temperatures[1000:].mean() == pytest.approx(300, abs=30)


def test_removing_the_motion_of_the_centre_changes_nothing() -> None:
    plain = run_with(waters(), lambda system: None, 500)
    removed = run_with(waters(), lambda system: system.addForce(openmm.CMMotionRemover(1)), 500)
    np.testing.assert_allclose(removed[0], plain[0], rtol=1e-6)
    assert removed[2] == plain[2]


def test_a_barostat_runs() -> None:
    """A change of positions costs the forces there, and the densities go on."""
    from run_support import smooth_cutoff, solvated

    modeller, force_field = solvated(count=60)
    system = smooth_cutoff(
        force_field.createSystem(
            modeller.topology, nonbondedMethod=openmm.app.CutoffPeriodic, nonbondedCutoff=0.55 * openmm.unit.nanometer
        ),
        0.45,
    )
    barostat = openmm.MonteCarloBarostat(1000, 300, 5)
    barostat.setRandomNumberSeed(4)
    system.addForce(barostat)
    integrator = automatic(0.001, 50)
    context = open_context(system, integrator, "Reference")
    context.setPositions(modeller.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 50)
    context.setVelocitiesToTemperature(300, 6)
    volumes, densities = set(), []
    for _ in range(100):
        integrator.step(1)
        densities.append(integrator.getStepDensity())
        volumes.add(value(context.getState().getPeriodicBoxVolume()))
    assert len(volumes) > 3
    assert np.mean(densities) < 1.1


@pytest.mark.parametrize("make, step", [(whip, 0.003), (waters, 0.001)])
def test_steps_cut_short_go_on_with_their_densities(make: Callable[[], Model], step: float) -> None:
    """A run in pieces of arbitrary length keeps to the densities of a run in one piece."""
    model, end = make(), 1.0
    integrator = automatic(step, 200, 1e-10)
    context = open_context(model.system(), integrator, "Reference", model)
    times, densities = [], []
    while time_of(context) < 1.2 * end:
        integrator.step(1)
        times.append(time_of(context))
        densities.append(integrator.getStepDensity())
    pieces = automatic(step, 200, 1e-10)
    other = open_context(model.system(), pieces, "Reference", model)
    rng = np.random.default_rng(5)
    energies = [energy_of(other)]
    for stop in np.sort(rng.uniform(0, 0.95 * end, 40)):
        if stop > time_of(other):
            pieces.stepTo(float(stop))
            assert time_of(other) == stop
        pieces.step(2)
        energies.append(energy_of(other))
        there = np.interp(time_of(other), times, densities)
        assert pieces.getStepDensity() == pytest.approx(there, rel=0.25)
    assert np.ptp(energies) < 0.02 * abs(energies[0])


def test_without_constraints(platform: str) -> None:
    """Two argon atoms that collide head-on at 2 km/s."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    for _ in range(2):
        system.addParticle(39.95)
        force.addParticle(0, 0.34, 1.0)
    system.addForce(force)
    errors, steps = [], 0
    for is_automatic in (True, False):
        integrator = automatic(0.008, 20) if is_automatic else VariableStepRattleIntegrator(0.6 / steps, monitors=[])
        context = open_context(system, integrator, platform)
        context.setPositions([[0, 0, 0], [0.9, 0.05, 0]])
        context.setVelocities([[1, 0, 0], [-1, 0, 0]])
        start, worst, steps = energy_of(context), 0.0, 0
        while time_of(context) < 0.6:
            integrator.step(1)
            steps += 1
            worst = max(worst, abs(energy_of(context) - start))
        errors.append(worst)
    print(f"largest energy errors {errors} kJ/mol, {steps} steps")
    assert errors[0] < 0.5 * errors[1]


# --------------------------------------------------------------------------------------------------------- errors


def test_a_system_in_which_nothing_happens_is_named() -> None:
    system = openmm.System()
    for _ in range(2):
        system.addParticle(14.0)
    system.addConstraint(0, 1, 0.11)
    integrator = automatic(0.001, 10)
    context = open_context(system, integrator, "Reference")
    context.setPositions([[0, 0, 0], [0.11, 0, 0]])
    for velocities in (np.zeros((2, 3)), np.full((2, 3), 0.7)):
        context.setVelocities(velocities)
        with pytest.raises(openmm.OpenMMException, match=r"no force and nothing turns.*clearMonitors"):
            integrator.step(1)
        np.testing.assert_array_equal(positions_of(context), [[0, 0, 0], [0.11, 0, 0]])
    # A rotor in free flight has constraint forces, which do not vary: fixed steps.
    context.setVelocities([[0, 1, 0.3], [0, -1, 0.3]])
    np.testing.assert_allclose(densities_of(integrator, 100), 1, rtol=1e-5)
    np.testing.assert_allclose(densities_of(integrator, 100), integrator.getStepDensity(), rtol=1e-6)


def test_wrong_arguments() -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    for steps in (0, -3):
        with pytest.raises(openmm.OpenMMException, match="at least one calibration step"):
            integrator.useAutomaticStepControl(steps)
    assert not integrator.isAutomatic()
    with pytest.raises(TypeError, match="calibrationSteps must be an integer"):
        integrator.useAutomaticStepControl(2.5)
    with pytest.raises(TypeError, match="automatic must be True or False"):
        VariableStepRattleIntegrator(0.001, automatic="yes")
    for name, argument in (("updateMethod", 1), ("maximumStepSize", 0.002), ("monitors", [1])):
        with pytest.raises(ValueError, match=f"takes the place of {name}"):
            VariableStepRattleIntegrator(0.001, automatic=True, **{name: argument})
    integrator.useAutomaticStepControl(5)
    for index in (-1, 2):
        for call in (integrator.getReferenceMonitorValue, integrator.getMonitorValue):
            with pytest.raises(openmm.OpenMMException, match=r"no monitor with index|not bound"):
                call(index)
        with pytest.raises(openmm.OpenMMException, match="automatic step control has two"):
            integrator.setReferenceMonitorValue(1.0, index)


def test_a_calibration_that_fails_takes_shorter_steps() -> None:
    """Fixed steps that no constraint survives: the trial run is repeated with shorter ones; hopeless ones are named."""
    test = light_heavy_chain()
    integrator = automatic(0.05, 100)
    context = open_context(test.system, integrator, "Reference", test)
    integrator.step(50)
    assert integrator.getNumForceEvaluations() > 200
    hopeless = automatic(1e3, 10)
    context = open_context(test.system, hopeless, "Reference", test)
    with pytest.raises(openmm.OpenMMException, match=r"trial run of automatic step control.*smaller step size"):
        hopeless.step(1)
    np.testing.assert_array_equal(positions_of(context), test.positions)


# ------------------------------------------------------------------------------------------------------ the benchmark


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return load_script("benchmarks/automatic.py")


def test_the_benchmark_runs(benchmark: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--quick", "--systems", "whip", "8 waters", "--output", str(tmp_path)]) == 0
    lines = (tmp_path / "automatic.jsonl").read_text(encoding="utf-8").splitlines()
    results = [json.loads(line) for line in lines]
    assert [r["system"] for r in results] == ["whip", "whip", "8 waters", "8 waters"]
    for result in results:
        assert result["gain"] > 0.5
        assert 0 < result["counted_gain"] < result["gain"]
    assert "| whip |" in capsys.readouterr().out
    for name in ("gains.png", "monitors.png"):
        assert (tmp_path / name).read_bytes()[1:4] == b"PNG"


def test_the_benchmark_finds_a_loss(benchmark: ModuleType) -> None:
    good, bad = (benchmark.Run(1000, 302, error, 0.001, 1.0) for error in (1.0, 1.2))
    whip, water = benchmark.PROBLEMS["whip"], benchmark.PROBLEMS["8 waters"]
    assert benchmark.faults([benchmark.summary(water, 1000, [(bad, good), (good, good)])]) == []
    assert len(benchmark.faults([benchmark.summary(water, 1000, [(good, bad), (good, good)])])) == 1
    assert len(benchmark.faults([benchmark.summary(whip, 1000, [(bad, good)])])) == 1


def test_the_documentation_claims_what_was_measured(benchmark: ModuleType) -> None:
    """Every system of the benchmark is in the table, twice, with a gain not below its claim."""
    page = (ROOT / "docs" / "automatic.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+?) \| ([\d,]+) \| ([\d.e+,]+) \|", page, re.MULTILINE)
    for name, problem in benchmark.PROBLEMS.items():
        gains = [float(gain.replace(",", "")) for system, _, gain in rows if system == name]
        assert len(gains) == 2, name
        assert min(gains) >= problem.least_gain, name
