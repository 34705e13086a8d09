# OpenMM-VRATTLE: automatic step control against an independent statement, and what users rely on.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import copy
import json
import re
import warnings
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
from openmmvrattle import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator, XmlSerializer
from openmmvrattle.testsystems import (
    TestSystem,
    alanine_dipeptide,
    light_heavy_chain,
    nitrogen_collision,
    rigid_waters,
    water_clash,
)
from project_scripts import load_script

ROOT = Path(__file__).parents[2]
LENGTH, FLIGHT = 0.0125, 0.4  # nm, of the product of force and squared speed, and of free flight
POWERS = (2 / 3, 0.8)
DEAD_ZONE = 2.5
KT_300 = 300 * 0.00831446  # kJ/mol


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
    """The monitors and the update of docs/automatic_method.md with dense matrices."""

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
        """S_c from the net forces themselves."""
        force = self.forces(q)
        momenta = self.c.masses[:, None] * v
        multipliers = self.c.multipliers(q.ravel(), momenta.ravel(), -force.ravel())
        net = force - (self.c.jacobian(q.ravel()).T @ multipliers).reshape(-1, 3)
        each = np.sum(net**2, axis=1) / self.c.masses + self.c.masses * np.sum(v**2, axis=1) ** 2 / FLIGHT**2
        return np.array([np.sum(each[c]) for c in self.clusters])

    def on_step(self, q: Array, v: Array) -> float:
        power = np.linalg.norm(self.forces(q), axis=1) * np.sum(v**2, axis=1) / LENGTH
        a = self.squares(q, v) + np.array([np.sum(power[c]) for c in self.clusters])
        return float(np.sum(a**4) ** (1 / 8))

    def half_step(self, q0: Array, v0: Array, q1: Array, v1: Array, size: float) -> float:
        rate = np.sum((q1 - q0) / size * (self.forces(q1) - self.forces(q0)), axis=1)
        b = 3 * 2 / size * np.abs([np.sum(rate[c]) for c in self.clusters])
        b = b + (self.squares(q0, v0) + self.squares(q1, v1)) / 2
        return float(np.sum(b**4) ** (1 / 8))

    def thermal(self, v: Array, step: float) -> float:
        """A monitor where each cluster's momentum changes by the thermal one in a step, at 300 K or more."""
        freedoms = 3 * len(self.c.masses) - len(self.c.jacobian(np.ones(3 * len(self.c.masses))))
        kt = max(float(np.sum(self.c.masses[:, None] * v**2)) / freedoms, KT_300)
        return np.sqrt(kt) / step * len(self.clusters) ** (1 / 8)


def f(x: float) -> float:
    return x - 0.75 - 1 / (16 * (x - 0.75))


def inverse(y: float) -> float:
    return 0.75 + (y + np.sqrt(y**2 + 0.25)) / 2


def limited(rho: float, largest: float = 1000) -> float:
    return 1 + (rho - 1) / (1 + ((rho - 1) / (largest - 1)) ** 16) ** (1 / 16) if rho > 1 else rho


def target(u: float, reference: float, power: float, largest: float = 1000) -> float:
    x = (u / reference) ** power / DEAD_ZONE
    phi = (1 + max(0, x**4 - 0.8**4) ** 4) ** (1 / 16)
    return f(limited(phi, largest))


def density(a: float, b: float, largest: float = 1000) -> float:
    return limited(float(np.sqrt((inverse(a) ** 2 + inverse(b) ** 2) / 2)), largest)


def test_f_is_inverted() -> None:
    for x in (0.7500001, 0.8, 1, 3, 1e3):
        assert inverse(f(x)) == pytest.approx(x, rel=1e-12)


class Sequences:
    """The recursion of the two densities, from the start on."""

    def __init__(self, u_a: float, references: list[float], largest: float = 1000) -> None:
        self.references, self.largest, self.steps = references, largest, 0
        self.last = [target(u_a, references[0], POWERS[0], largest)] * 2
        self.next = list(self.last)

    def density(self) -> float:
        return density(*self.next, self.largest)

    def move(self, values: list[float]) -> None:
        wanted = [target(values[k], self.references[k], POWERS[k], self.largest) for k in range(2)]
        if self.steps < 30:
            for k in range(2):
                self.last[k] += 0.1 * (wanted[k] - self.last[k])
                self.next[k] += 0.1 * (wanted[k] - self.next[k])
        self.steps += 1
        a, b = 2 * wanted[0] - self.next[0], 2 * wanted[1] - self.last[1]
        self.last, self.next = self.next, [a, b]


@pytest.mark.parametrize("make, step, range_of_steps", [(chain, 0.002, 1.5), (waters, 0.004, 1.3), (whip, 0.003, 1.3)])
def test_against_an_independent_statement(make: Callable[[], Model], step: float, range_of_steps: float) -> None:
    """References, start, monitors and density of every step; and these steps are not all the same."""
    model, learning = make(), 7
    statement = Statement(model)
    integrator = automatic(step, learning, 1e-12)
    context = open_context(model.system(), integrator, "Reference", model)

    def take(expected: float) -> list[float]:
        nonlocal q, v
        integrator.step(1)
        assert integrator.getStepDensity() == pytest.approx(expected, rel=1e-6)
        size = value(integrator.getStepSize())
        assert size == pytest.approx(step / integrator.getStepDensity(), rel=1e-12)
        densities.append(integrator.getStepDensity())
        new_q, new_v = positions_of(context), velocities_of(context)
        values = [statement.on_step(new_q, new_v), statement.half_step(q, v, new_q, new_v, size)]
        for k in range(2):
            assert integrator.getMonitorValue(k) == pytest.approx(values[k], rel=1e-6)
        q, v = new_q, new_v
        return values

    # The first steps are nominal ones, and the geometric means over them are the references.
    q, v, densities = model.positions, model.velocities, []
    found = []
    for _ in range(learning):
        assert [integrator.getReferenceMonitorValue(k) for k in range(2)] == [0, 0]
        found.append(take(1.0))
    references = [float(r) for r in np.exp(np.mean(np.log(found), axis=0))]
    for k in range(2):
        assert integrator.getReferenceMonitorValue(k) == pytest.approx(references[k], rel=1e-6)
    # With lower ones something happens.
    for factor in (10, 30):
        sequence = Sequences(
            statement.on_step(model.positions, model.velocities), [each / factor for each in references]
        )
        for k in range(2):
            integrator.setReferenceMonitorValue(sequence.references[k], k)
        context.setPositions(model.positions)
        context.setVelocities(model.velocities)
        q, v, densities = model.positions, model.velocities, []
        for _ in range(60):
            sequence.move(take(sequence.density()))
    assert max(densities) / min(densities) > range_of_steps


def test_a_clash_is_seen_at_once() -> None:
    """References in thermal units, from the first step on; and they stay."""
    test = water_clash()
    model = model_of(test)
    statement = Statement(model)
    step = 0.001
    u_a, unit_of_u = statement.on_step(model.positions, model.velocities), statement.thermal(model.velocities, step)
    assert u_a > 8 * unit_of_u
    integrator = automatic(step, tolerance=1e-12)
    context = open_context(test.system, integrator, "Reference", test)
    integrator.step(1)
    sequence = Sequences(u_a, [0.4 * unit_of_u] * 2)
    assert integrator.getStepDensity() == pytest.approx(sequence.density(), rel=1e-6)
    assert integrator.getStepDensity() > 10
    integrator.step(300)
    for k in range(2):
        assert integrator.getReferenceMonitorValue(k) == pytest.approx(0.4 * unit_of_u, rel=1e-6)
    assert time_of(context) > 0.01


def test_half_step_monitor_is_a_second_derivative() -> None:
    """On free particles without constraints, 6/dt w.(F1 - F0) is minus six times what V differentiated twice has."""
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
        b.append(6 * abs(speed @ hessian @ speed) + force @ force / mass + mass * (speed @ speed) ** 2 / FLIGHT**2)
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
    integrator = automatic(step, tolerance=1e-13)
    context = open_context(model.system(), integrator, platform, model)
    densities = densities_of(integrator, 1000)
    assert integrator.getNumForceEvaluations() == 1001
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


def test_a_large_cluster_is_not_hard_for_its_size() -> None:
    """A chain of 3,000 rigid bonds is one cluster, in which thermal motion adds up."""
    count, rise, half_width = 3000, 0.126, 0.04
    system, angles = openmm.System(), openmm.HarmonicAngleForce()
    for i in range(count):
        system.addParticle(14)
        if i > 0:
            system.addConstraint(i - 1, i, float(np.hypot(rise, 2 * half_width)))
        if i > 1:
            angles.addAngle(i - 2, i - 1, i, np.pi - 2 * np.arctan(2 * half_width / rise), 500)
    system.addForce(angles)
    start = np.array([[rise * i, half_width * (-1) ** i, 0] for i in range(count)])
    bath = VariableStepRattleLangevinIntegrator(300, 20, 0.002, randomNumberSeed=1)
    warm = openmm.Context(system, bath, openmm.Platform.getPlatform("CPU"))
    warm.setPositions(start)
    bath.setVelocitiesToTemperature(300, 1)
    bath.step(1000)
    integrator = automatic(0.002)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("CPU"))
    context.setState(warm.getState(positions=True, velocities=True))
    # Far more than 8 of the units of small molecules: sqrt(2K/f)/stepSize.
    densities = densities_of(integrator, 100)
    assert integrator.getMonitorValue() > 10 * np.sqrt(2.494) / 0.002
    assert np.all(densities == 1)
    assert integrator.getReferenceMonitorValue(0) == pytest.approx(integrator.getMonitorValue(), rel=0.2)


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
    """And one more at the start, whatever is learnt on the way."""
    model = waters()
    system, calls = counted(model)
    integrator = automatic(0.001, 25)
    context = open_context(system, integrator, platform, model)
    calls[0] = 0
    integrator.step(1)
    assert calls[0] == 2 == integrator.getNumForceEvaluations()
    integrator.step(200)
    assert calls[0] == 202 == integrator.getNumForceEvaluations()
    # Calm steps are those of fixed steps.
    np.testing.assert_array_equal(densities_of(integrator, 100), 1.0)
    other = VariableStepRattleIntegrator(0.001, monitors=[])
    again = open_context(system, other, platform, model)
    other.step(301)
    np.testing.assert_allclose(
        positions_of(again), positions_of(context), rtol=0, atol=1e-6 if platform == "Reference" else 1e-3
    )


def test_a_change_by_the_user_costs_the_forces() -> None:
    """References stay, unless there are much larger velocities."""
    model = waters()
    integrator = automatic(0.001, 25)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(30)

    def references() -> list[float]:
        return [integrator.getReferenceMonitorValue(k) for k in range(2)]

    before_changes = references()
    changes: list[Callable[[], Any]] = [
        lambda: context.setVelocities(velocities_of(context)),
        lambda: context.setPositions(positions_of(context)),
        lambda: context.setPeriodicBoxVectors([3, 0, 0], [0, 3, 0], [0, 0, 3]),
    ]
    for change in changes:
        change()
        before = integrator.getNumForceEvaluations()
        integrator.step(5)
        assert integrator.getNumForceEvaluations() == before + 1 + 5
        assert references() == before_changes
    context.setVelocities(1.4 * velocities_of(context))
    integrator.step(1)
    assert references() == before_changes
    context.setVelocities(3 * velocities_of(context))
    integrator.step(1)
    assert references() == [0, 0]
    integrator.step(25)
    assert all(new > old for new, old in zip(references(), before_changes, strict=True))
    before = integrator.getNumForceEvaluations()
    integrator.useAutomaticStepControl(10)
    integrator.step(5)
    assert references() == [0, 0]
    integrator.step(5)
    assert min(references()) > 0
    assert integrator.getNumForceEvaluations() == before + 10
    integrator.calibrate(10)
    assert integrator.getNumForceEvaluations() == before + 20


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
    evaluations = integrator.getNumForceEvaluations()
    integrator.step(20)
    assert integrator.getNumForceEvaluations() == evaluations + 21
    fresh = automatic(0.001)
    for k in range(2):
        fresh.setReferenceMonitorValue(integrator.getReferenceMonitorValue(k), k)
    other = open_context(system, fresh, "Reference")
    other.setParameter("k", 100.0)
    other.setPositions(position)
    other.setVelocities(velocity)
    fresh.step(20)
    # The one goes on with its density and the other starts one, both close to 1 in the dead zone.
    np.testing.assert_allclose(positions_of(context), positions_of(other), rtol=0, atol=1e-9)


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
    assert other.getNumForceEvaluations() <= 102
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
    assert evaluations == 1 + 5000
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


def test_a_system_in_which_nothing_happens_runs() -> None:
    """An ideal gas, at rest and in flight; and a rotor, whose forces do not vary."""
    system = openmm.System()
    for _ in range(2):
        system.addParticle(14.0)
    system.addConstraint(0, 1, 0.11)
    for velocities in (np.zeros((2, 3)), np.full((2, 3), 0.7), np.array([[0, 1, 0.3], [0, -1, 0.3]])):
        integrator = automatic(0.001, 10)
        context = open_context(system, integrator, "Reference")
        context.setPositions([[0, 0, 0], [0.11, 0, 0]])
        context.setVelocities(velocities)
        np.testing.assert_array_equal(densities_of(integrator, 100), 1.0)
        known = [integrator.getReferenceMonitorValue(k) > 0 for k in range(2)]
        assert known == [bool(np.any(velocities))] * 2
        assert time_of(context) == pytest.approx(0.1)


def test_references_are_found_as_soon_as_there_is_something() -> None:
    """Two atoms at rest, until a field is switched on."""
    system = openmm.System()
    field = openmm.CustomExternalForce("e*x^2")
    field.addGlobalParameter("e", 0.0)
    for _ in range(2):
        field.addParticle(system.addParticle(14.0))
    system.addForce(field)
    integrator = automatic(0.001)
    context = open_context(system, integrator, "Reference")
    context.setPositions([[0.1, 0, 0], [0.3, 0, 0]])
    integrator.step(200)
    assert integrator.getReferenceMonitorValue(0) == 0
    np.testing.assert_array_equal(positions_of(context), [[0.1, 0, 0], [0.3, 0, 0]])
    context.setParameter("e", 100.0)
    densities = densities_of(integrator, 1000)
    assert integrator.getReferenceMonitorValue(0) > 0
    assert densities.mean() < 1.5


def test_dilute_gas_costs_little() -> None:
    """Two argon atoms, three diameters apart or more, with a step of 4 fs that is right for them."""
    for distance in (1.0, 3.0):
        steps, errors = [], []
        for is_automatic in (True, False):
            system = openmm.System()
            force = openmm.NonbondedForce()
            for _ in range(2):
                force.addParticle(0, 0.33, 0.99)
                system.addParticle(39.9)
            system.addForce(force)
            integrator = automatic(0.004) if is_automatic else VariableStepRattleIntegrator(0.004, monitors=[])
            context = open_context(system, integrator, "Reference")
            context.setPositions([[-distance / 2, -0.02, 0], [distance / 2, 0.02, 0]])
            context.setVelocities([[0.25, 0, 0], [-0.25, 0, 0]])
            start, worst, count = energy_of(context), 0.0, 0
            while time_of(context) < 2 * distance + 3:
                integrator.step(1)
                count += 1
                worst = max(worst, abs(energy_of(context) - start))
            steps.append(count)
            errors.append(worst)
        print(f"{distance} nm: {steps} steps, largest errors {errors}")
        assert steps[0] < 2 * steps[1]
        assert errors[0] <= errors[1]


@pytest.mark.parametrize("rate", [1, 20])
def test_a_cold_start_is_no_trap(rate: float) -> None:
    """Minimised and at rest, and warmed by a thermostat: after 1 ps the pace is the nominal one."""
    test = alanine_dipeptide()
    minimizer = openmm.VerletIntegrator(0.001)
    context = open_context(test.system, minimizer, "Reference", test)
    openmm.LocalEnergyMinimizer.minimize(context, 1e-3)
    positions = positions_of(context)
    system = copy.deepcopy(test.system)
    thermostat = openmm.AndersenThermostat(300, rate)
    thermostat.setRandomNumberSeed(5)
    system.addForce(thermostat)
    integrator = automatic(0.001)
    context = open_context(system, integrator, "Reference")
    context.setPositions(positions)
    while time_of(context) < 1:
        integrator.step(10)
    assert context.getStepCount() < 2000
    before = time_of(context)
    integrator.step(1000)
    assert time_of(context) - before == pytest.approx(1.0, rel=0.01)


def test_a_cold_spring_is_no_trap() -> None:
    """Two atoms exactly at the minimum of their bond: all that there is are kicks, now and then."""
    system = openmm.System()
    bond = openmm.HarmonicBondForce()
    for mass in (12.0, 16.0):
        system.addParticle(mass)
    bond.addBond(0, 1, 0.12, 300000.0)
    system.addForce(bond)
    thermostat = openmm.AndersenThermostat(300, 1)
    thermostat.setRandomNumberSeed(5)
    system.addForce(thermostat)
    integrator = automatic(0.001)
    context = open_context(system, integrator, "Reference")
    context.setPositions([[0, 0, 0], [0.12, 0, 0]])
    integrator.step(5000)
    assert time_of(context) > 4.9


def test_references_follow_where_forces_change_the_state_and_only_there() -> None:
    """From a fifth of what is right they come back with a thermostat; without one they stay."""
    model = waters()
    for with_thermostat in (True, False):
        system = model.system()
        thermostat = openmm.AndersenThermostat(300, 20 if with_thermostat else 0)
        thermostat.setRandomNumberSeed(3)
        system.addForce(thermostat)
        integrator = automatic(0.001)
        context = open_context(system, integrator, "Reference", model)
        integrator.step(2000)
        right = [integrator.getReferenceMonitorValue(k) for k in range(2)]
        integrator.step(500)
        now = [integrator.getReferenceMonitorValue(k) for k in range(2)]
        assert (now != right) == with_thermostat
        for k in range(2):
            assert 0.4 < now[k] / right[k] < 2.5
        del context
    # The user's own stay also with a thermostat.
    system.getForce(system.getNumForces() - 1).setDefaultCollisionFrequency(20)
    integrator = automatic(0.001)
    for k in range(2):
        integrator.setReferenceMonitorValue(1e4, k)
    context = open_context(system, integrator, "Reference", model)
    integrator.step(200)
    assert context.getStepCount() == 200
    assert [integrator.getReferenceMonitorValue(k) for k in range(2)] == [1e4, 1e4]


def test_no_step_is_below_the_minimum() -> None:
    """By default a thousandth of the nominal step; and settable."""
    test = water_clash()
    for minimum in (None, 0.0004, 0.0009):
        integrator = automatic(0.001)
        assert value(integrator.getMinimumStepSize()) == pytest.approx(1e-6)
        for k in range(2):
            integrator.setReferenceMonitorValue(0.01, k)  # everything is hard
        if minimum is not None:
            integrator.setMinimumStepSize(minimum)
            assert value(integrator.getMinimumStepSize()) == minimum
        context = open_context(test.system, integrator, "Reference", test)
        sizes = []
        for _ in range(50):
            integrator.step(1)
            sizes.append(value(integrator.getStepSize()))
        least = minimum or 1e-6
        assert least * (1 - 1e-12) <= min(sizes) < 1.05 * least
        del context
    # Calm steps stay what they are.
    integrator = automatic(0.001)
    integrator.setMinimumStepSize(0.0009)
    context = open_context(rigid_waters(8).system, integrator, "Reference", rigid_waters(8))
    np.testing.assert_array_equal(densities_of(integrator, 50), 1.0)
    with pytest.raises(openmm.OpenMMException, match=r"minimum step size .* must be smaller than the nominal"):
        integrator.setMinimumStepSize(0.002)
        integrator.step(1)
    assert VariableStepRattleIntegrator(0.001, automatic=True, minimumStepSize=1e-5).getMinimumStepSize()._value == 1e-5
    del context


def test_a_run_that_crawls_says_so_once() -> None:
    test = rigid_waters(8)
    integrator = automatic(0.001)
    context = open_context(test.system, integrator, "Reference", test)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        integrator.step(50)
        for k in range(2):
            integrator.setReferenceMonitorValue(integrator.getReferenceMonitorValue(k) / 200, k)
        integrator.step(900)
    assert 800 < integrator.getNumShortSteps() <= 900
    with pytest.warns(UserWarning, match="1000 steps in a row that are shorter than a tenth"):
        integrator.step(200)
    checkpoint = context.createCheckpoint()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        integrator.step(100)
    most = integrator.getNumShortSteps()
    context.loadCheckpoint(checkpoint)
    integrator.step(100)
    assert integrator.getNumShortSteps() == most


def test_a_checkpoint_in_the_first_steps() -> None:
    """What has been learnt so far is part of it."""
    model = waters()
    integrator = automatic(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(13)
    checkpoint = context.createCheckpoint()
    integrator.step(20)
    references = [integrator.getReferenceMonitorValue(k) for k in range(2)]
    assert min(references) > 0
    context.loadCheckpoint(checkpoint)
    assert integrator.getReferenceMonitorValue(0) == 0
    integrator.step(20)
    assert [integrator.getReferenceMonitorValue(k) for k in range(2)] == references


@pytest.mark.parametrize("form", ["none", "checkpoint", "state", "reinitialize"])
def test_much_faster_velocities_before_a_checkpoint(form: str) -> None:
    """The temperature at which references were found is saved with them, also where the next step starts afresh."""
    model = waters()
    integrator = automatic(0.001, 10)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(20)
    reference = integrator.getReferenceMonitorValue(0)
    assert reference > 0
    context.setVelocities(3 * velocities_of(context))
    if form == "checkpoint":
        checkpoint = context.createCheckpoint()
        integrator = automatic(0.001, 10)
        context = open_context(model.system(), integrator, "Reference")
        context.loadCheckpoint(checkpoint)
    elif form == "state":
        state = context.getState(positions=True, velocities=True, integratorParameters=True)
        integrator = automatic(0.001, 10)
        context = open_context(model.system(), integrator, "Reference")
        context.setState(XmlSerializer.deserialize(XmlSerializer.serialize(state)))
    elif form == "reinitialize":
        context.reinitialize(preserveState=True)
    assert integrator.getReferenceMonitorValue(0) == reference
    integrator.step(1)
    assert integrator.getReferenceMonitorValue(0) == 0  # it is found anew


def test_references_stay_where_somebody_looks_at_a_start() -> None:
    """What is taken from the motion of the centre between that and the step is no thermostat."""
    model = waters()
    system = model.system()
    system.addForce(openmm.CMMotionRemover(1))
    integrator = automatic(0.001, 10)
    context = open_context(system, integrator, "Reference", model)
    integrator.step(60)
    references = [integrator.getReferenceMonitorValue(k) for k in range(2)]
    assert min(references) > 0
    context.setVelocities(velocities_of(context) + np.array([0.05, 0, 0]))
    integrator.getMultipliers()
    integrator.step(60)
    assert [integrator.getReferenceMonitorValue(k) for k in range(2)] == references
    assert np.abs(np.array(model.masses) @ velocities_of(context)).max() < 1e-10


def test_velocities_set_after_a_start_at_rest() -> None:
    """References of a frozen state do not slow down what is warm."""
    test = alanine_dipeptide()
    context = open_context(test.system, openmm.VerletIntegrator(0.001), "Reference", test)
    openmm.LocalEnergyMinimizer.minimize(context, 1e-3)
    positions = positions_of(context)
    integrator = automatic(0.001)
    context = open_context(test.system, integrator, "Reference")
    context.setPositions(positions)
    integrator.step(100)
    context.setVelocities(test.velocities)
    assert densities_of(integrator, 1000).mean() < 1.01


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
    integrator.calibrate(100)
    assert integrator.getNumForceEvaluations() > 101
    assert min(integrator.getReferenceMonitorValue(k) for k in range(2)) > 0
    hopeless = automatic(1e3, 10)
    context = open_context(test.system, hopeless, "Reference", test)
    with pytest.raises(openmm.OpenMMException, match=r"calibrate\(\).*smaller step size"):
        hopeless.calibrate(10)
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
    assert "| whip |" in capsys.readouterr().out
    for name in ("gains.png", "monitors.png"):
        assert (tmp_path / name).read_bytes()[1:4] == b"PNG"


def test_the_benchmark_of_unseen_systems_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unseen = load_script("benchmarks/automatic_unseen.py")
    names = ["heating by hand", "comet", "two N2, 1 nm", "cold spring"]
    assert unseen.main(["--quick", "--systems", *names, "--output", str(tmp_path)]) == 0
    lines = (tmp_path / "automatic_unseen.jsonl").read_text(encoding="utf-8").splitlines()
    results = [json.loads(line) for line in lines]
    assert [r["system"] for r in results] == names
    for result in results:
        assert 0.9 < result["automatic"]["steps"] / result["fixed"]["steps"] < 3
        assert result["automatic"]["time"] == pytest.approx(result["fixed"]["time"], rel=0.05)
    assert "| comet |" in capsys.readouterr().out


def test_the_benchmark_finds_a_loss(benchmark: ModuleType) -> None:
    good, bad = (benchmark.Run(1000, error, 0.001, 1.0) for error in (1.0, 1.2))
    whip, water = benchmark.PROBLEMS["whip"], benchmark.PROBLEMS["8 waters"]
    assert benchmark.faults([benchmark.summary(water, 1000, [(bad, good), (good, good)])]) == []
    assert len(benchmark.faults([benchmark.summary(water, 1000, [(good, bad), (good, good)])])) == 1
    assert len(benchmark.faults([benchmark.summary(whip, 1000, [(bad, good)])])) == 1


def test_the_documentation_claims_what_was_measured(benchmark: ModuleType) -> None:
    """Every system of the benchmark is in the table, twice, with a gain not below its claim."""
    page = (ROOT / "docs" / "automatic_benchmark.md").read_text(encoding="utf-8")
    table = re.search(r"<!-- measured: gains -->(.*?)<!-- end: gains -->", page, re.DOTALL)[1]
    rows = re.findall(r"^\| (.+?) \| ([\d,]+) \| ([\d.e+,]+) \|", table, re.MULTILINE)
    for name, problem in benchmark.PROBLEMS.items():
        gains = [float(gain.replace(",", "")) for system, _, gain in rows if system == name]
        assert len(gains) == 2, name
        assert min(gains) >= problem.least_gain, name
