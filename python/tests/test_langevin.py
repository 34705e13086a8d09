# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""VariableStepRattleLangevinIntegrator: its step, its state and what OpenMM does with it.

What it samples is tested in test_langevin_sampling.py.
"""

from __future__ import annotations

import copy
import inspect
import json
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pytest
from langevin_statement import BOLTZMANN, Statement, normal_numbers
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator, XmlSerializer
from openmmvrattle.integrators import ConstrainedIntegrator
from openmmvrattle.testsystems import constraint_error
from project_scripts import load_script
from run_support import degrees_of_freedom, fastest_platform, solvated

Langevin = VariableStepRattleLangevinIntegrator
REFERENCE = openmm.Platform.getPlatform("Reference")


def molecules() -> tuple[openmm.System, np.ndarray]:
    """A rigid water, a chain of three and a free particle that are charged and repel each other in a harmonic trap."""
    system = openmm.System()
    for mass in (16.0, 1.0, 1.0, 12.0, 2.0, 14.0, 40.0):
        system.addParticle(mass)
    positions = np.array(
        [[0, 0, 0], [0.08, 0.06, 0], [-0.08, 0.06, 0], [0.3, 0, 0], [0.39, 0.05, 0.02], [0.3, 0.1, 0.1], [0, 0.3, 0.1]]
    )
    for i, j in ((0, 1), (0, 2), (1, 2), (3, 4), (4, 5)):
        system.addConstraint(i, j, float(np.linalg.norm(positions[i] - positions[j])))
    forces = openmm.NonbondedForce()
    for charge in (-0.8, 0.4, 0.4, 0.3, -0.3, 0.0, 0.0):
        forces.addParticle(charge, 0.2, 0.5)
    for i, j in ((0, 1), (0, 2), (1, 2), (3, 4), (4, 5), (3, 5)):
        forces.addException(i, j, 0, 1, 0)
    system.addForce(forces)
    trap = openmm.CustomExternalForce("200*(x^2+y^2+z^2)")
    for i in range(7):
        trap.addParticle(i, [])
    system.addForce(trap)
    return system, positions


def numbers(quantity: Any) -> np.ndarray:
    return np.array(quantity._value)


def open_context(
    system: openmm.System, integrator: openmm.Integrator, positions: Any, temperature: float = 300, seed: int = 1
) -> openmm.Context:
    context = openmm.Context(system, integrator, REFERENCE)
    context.setPositions(positions)
    context.setVelocitiesToTemperature(temperature, seed)
    return context


def make_context(**settings: Any) -> tuple[openmm.Context, Langevin]:
    integrator = Langevin(300, 5, 0.004, randomNumberSeed=7)
    for name, value in settings.items():
        getattr(integrator, name)(value)
    system, positions = molecules()
    return open_context(system, integrator, positions), integrator


def state_of(context: openmm.Context) -> tuple[np.ndarray, np.ndarray]:
    state = context.getState(positions=True, velocities=True)
    return numbers(state.getPositions(True)), numbers(state.getVelocities(True))


def make_statement(system: openmm.System, integrator: Langevin) -> Statement:
    """The same system and settings, with forces from OpenMM."""
    only_forces = openmm.Context(copy.deepcopy(system), openmm.VerletIntegrator(0.001), REFERENCE)

    def force(q: np.ndarray) -> np.ndarray:
        only_forces.setPositions(q)
        return numbers(only_forces.getState(forces=True).getForces(True))

    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    pairs = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    return Statement(
        masses,
        [(i, j, length._value) for i, j, length in pairs],
        force,
        integrator.getTemperature()._value,
        integrator.getFriction()._value,
        integrator.getStepSize()._value,
    )


# The step


@pytest.mark.parametrize("friction", [0, 5, 300])
@pytest.mark.parametrize("doublings", [None, 0, 1, 3])
def test_steps_are_those_of_the_statement(doublings: int | None, friction: float) -> None:
    context, integrator = make_context(setFriction=friction, setConstraintTolerance=1e-12)
    statement = make_statement(context.getSystem(), integrator)
    q, v = state_of(context)
    v = statement.project(q, v)
    if doublings is not None:
        asked = 0.5 if doublings == 0 else 0.9 * 2**doublings
        integrator.setReferenceMonitorValue(integrator.getMonitorValue() / (2.2 * asked) ** 1.5)
        statement.reference = integrator.getReferenceMonitorValue()
    substepped, evaluations = 0, integrator.getNumForceEvaluations()
    taken = []
    for i in range(6):
        if doublings is not None:
            statement.reference = integrator.getReferenceMonitorValue()
        q, v, k = statement.step(q, v, normal_numbers(7, i, len(q)))
        integrator.step(1)
        taken.append(k)
        substepped += k > 0
        positions, velocities = state_of(context)
        assert np.max(np.abs(positions - q)) < 1e-10
        assert np.max(np.abs(velocities - v)) < 1e-7
        if doublings is None:
            assert integrator.getReferenceMonitorValue() == pytest.approx(statement.reference, rel=1e-9)
    assert taken[0] >= (doublings or 0)
    assert integrator.getNumSubstepped() == substepped
    assert integrator.getLargestSubsteps() == (1 if max(taken) == 0 else 2 ** max(taken) + 1)
    assert integrator.getNumForceEvaluations() - evaluations >= sum(1 if k == 0 else 2**k + 1 for k in taken)


def test_the_kinetic_energy_is_that_of_the_half_step() -> None:
    context, integrator = make_context()
    statement = make_statement(context.getSystem(), integrator)
    integrator.setReferenceMonitorValue(1e9)
    for substeps, reference in ((1, 1e9), (1025, 1e-3)):
        if substeps > 1:
            integrator.setMaximumSubsteps(5)
        integrator.setReferenceMonitorValue(reference)
        integrator.step(1)
        q, v = state_of(context)
        d = 0.004 / min(substeps, 5)
        half = statement.project(q, v - d / 2 * statement.force(q) / statement.masses[:, None])
        expected = 0.5 * np.sum(statement.masses[:, None] * half**2)
        state = context.getState(energy=True, forces=True)
        assert state.getKineticEnergy()._value == pytest.approx(expected, rel=1e-8)
        assert np.allclose(numbers(state.getForces(True)), statement.force(q), atol=1e-6)
        assert abs(expected / (0.5 * np.sum(statement.masses[:, None] * v**2)) - 1) > 1e-5
    # Before a step as well, and without touching the forces that are asked for.
    context.getSystem().getForce(1).setForceGroup(1)
    context.reinitialize(preserveState=True)
    v *= 1.1  # other ones, for with the same the run goes on
    context.setVelocities(v)
    evaluations = integrator.getNumForceEvaluations()
    state = context.getState(energy=True, forces=True, groups={1})
    assert integrator.getNumForceEvaluations() - evaluations <= 1
    assert np.allclose(numbers(state.getForces(True)), -400 * q, rtol=1e-9)
    half = statement.project(q, v - 0.002 * statement.force(q) / statement.masses[:, None])
    assert state.getKineticEnergy()._value == pytest.approx(0.5 * np.sum(statement.masses[:, None] * half**2), rel=1e-7)


def test_without_friction_it_is_rattle() -> None:
    """The energy is conserved as by the integrator of constant energy with fixed steps, and no worse."""
    system, positions = molecules()
    fluctuations = []
    for integrator in (Langevin(300, 0, 0.001), VariableStepRattleIntegrator(0.001, monitors=[])):
        if isinstance(integrator, Langevin):
            integrator.setMaximumSubsteps(1)
        context = open_context(copy.deepcopy(system), integrator, positions)
        integrator.step(1)
        energies = []
        for _ in range(400):
            integrator.step(1)
            q, v = state_of(context)
            kinetic = 0.5 * sum(system.getParticleMass(i)._value * v[i] @ v[i] for i in range(len(v)))
            energies.append(kinetic + context.getState(energy=True).getPotentialEnergy()._value)
        fluctuations.append(np.std(energies))
    print(f"standard deviation of the energy: {fluctuations[0]:.2e} and {fluctuations[1]:.2e} kJ/mol")
    assert fluctuations[0] < 1.5 * fluctuations[1] < 0.5


def test_a_damped_oscillator() -> None:
    """At a temperature of zero: r - r0 goes as exp(-gamma t/2) cos(omega t)."""
    system = openmm.System()
    bond = openmm.HarmonicBondForce()
    for _ in range(2):
        system.addParticle(2.0)
    bond.addBond(0, 1, 1.5, 1.0)
    system.addForce(bond)
    integrator = Langevin(0, 0.1, 0.01)
    context = openmm.Context(system, integrator, REFERENCE)
    context.setPositions([[-1, 0, 0], [1, 0, 0]])
    omega = np.sqrt(1 - 0.05**2)
    for _ in range(1000):
        integrator.step(1)
        t = context.getTime()._value
        q, v = state_of(context)
        decay = 0.5 * np.exp(-0.05 * t)
        # To first order in gamma/omega, for the start is at rest and not on that curve.
        assert q[1, 0] - q[0, 0] == pytest.approx(1.5 + decay * np.cos(omega * t), abs=0.03)
        assert v[1, 0] - v[0, 0] == pytest.approx(-decay * omega * np.sin(omega * t), abs=0.03)


@pytest.mark.parametrize("name", ["CPU", "OpenCL", "CUDA", "HIP"])
def test_platforms_agree(name: str) -> None:
    """With the same noise, to the precision of their forces."""
    try:
        platform = openmm.Platform.getPlatform(name)
        openmm.Context(molecules()[0], openmm.VerletIntegrator(0.001), platform)
    except openmm.OpenMMException as error:
        pytest.skip(str(error))
    ends = []
    for each in (REFERENCE, platform):
        integrator = Langevin(300, 5, 0.004, randomNumberSeed=7)
        system, positions = molecules()
        context = openmm.Context(system, integrator, each)
        context.setPositions(positions)
        integrator.setVelocitiesToTemperature(300, 1)
        kinetic = []
        for _ in range(10):
            integrator.step(1)
            kinetic.append(context.getState(energy=True).getKineticEnergy()._value)
        ends.append((state_of(context)[0], kinetic, integrator.getNumForceEvaluations()))
    assert np.max(np.abs(ends[0][0] - ends[1][0])) < 1e-4
    assert ends[0][1] == pytest.approx(ends[1][1], rel=1e-2)
    assert ends[0][2] == ends[1][2]


def test_a_temperature_of_zero_cools() -> None:
    context, integrator = make_context(setTemperature=0, setFriction=50)
    integrator.step(500)
    assert context.getState(energy=True).getKineticEnergy()._value < 1


# State


def test_a_checkpoint_goes_on_to_the_last_bit() -> None:
    """Random numbers and U_ref among all else, from the middle of a run and from a start that has not been taken."""
    context, integrator = make_context(setRandomNumberSeed=0)
    for steps in (0, 13):
        integrator.step(steps)
        if steps == 0:
            context.getState(energy=True)
        checkpoint = context.createCheckpoint()
        integrator.step(20)
        expected, reference = state_of(context), integrator.getReferenceMonitorValue()
        for _ in range(2):
            other, fresh = make_context(setTemperature=77, setRandomNumberSeed=5)
            fresh.step(3)
            other.loadCheckpoint(checkpoint)
            fresh.step(20)
            assert all(np.array_equal(a, b) for a, b in zip(state_of(other), expected, strict=True))
            assert fresh.getReferenceMonitorValue() == reference
            assert fresh.getTemperature()._value == 300
        context.loadCheckpoint(checkpoint)
        integrator.step(20)
        assert all(np.array_equal(a, b) for a, b in zip(state_of(context), expected, strict=True))


def test_a_state_goes_on_with_the_noise_of_its_own_integrator() -> None:
    context, integrator = make_context()
    integrator.step(10)
    xml = openmm.XmlSerializer.serialize(
        context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
    )
    reference = integrator.getReferenceMonitorValue()
    integrator.step(5)
    ends = []
    for seed, first in ((7, 7), (8, 8), (8, 7)):
        other, fresh = make_context(setRandomNumberSeed=first, setTemperature=77)
        fresh.setRandomNumberSeed(seed)  # the Context may exist already
        other.setState(openmm.XmlSerializer.deserialize(xml))
        assert fresh.getReferenceMonitorValue() == reference
        assert (fresh.getTemperature()._value, fresh.getRandomNumberSeed()) == (300, seed)
        fresh.step(5)
        ends.append(state_of(other)[0])
    assert np.max(np.abs(ends[0] - state_of(context)[0])) < 1e-9
    assert np.max(np.abs(ends[1] - ends[0])) > 1e-4
    assert np.array_equal(ends[1], ends[2])


def test_reinitialize_goes_on() -> None:
    context, integrator = make_context(setRandomNumberSeed=0)
    integrator.step(5)
    checkpoint = context.createCheckpoint()
    integrator.step(5)
    expected = state_of(context)
    context.loadCheckpoint(checkpoint)
    context.reinitialize(preserveState=True)
    integrator.step(5)
    assert np.array_equal(state_of(context)[0], expected[0])


def test_seeds() -> None:
    ends = []
    for seed in (3, 3, 4, 0, 0):
        context, integrator = make_context(setRandomNumberSeed=seed)
        integrator.step(3)
        ends.append(state_of(context)[0])
        assert integrator.getRandomNumberSeed() == seed
    assert np.array_equal(ends[0], ends[1])
    for i, j in ((0, 2), (0, 3), (3, 4)):
        assert np.max(np.abs(ends[i] - ends[j])) > 1e-5


def configured() -> Langevin:
    integrator = Langevin(310 * unit.kelvin, 2 / unit.picosecond, 3 * unit.femtosecond)
    integrator.setConstraintTolerance(1e-6)
    integrator.setRandomNumberSeed(11)
    integrator.setMaximumSubsteps(65)
    integrator.setReferenceMonitorValue(123.5)
    integrator.freezeReference(True)
    integrator.setIntegrationForceGroups({0, 3})
    integrator.addConstraint("x1 - a", [2], {"a": 0.25})
    return integrator


def settings_of(integrator: Langevin) -> tuple[Any, ...]:
    return (
        integrator.getTemperature()._value,
        integrator.getFriction()._value,
        integrator.getStepSize()._value,
        integrator.getConstraintTolerance(),
        integrator.getRandomNumberSeed(),
        integrator.getMaximumSubsteps(),
        integrator.getReferenceMonitorValue(),
        integrator.isReferenceFrozen(),
        integrator.getIntegrationForceGroups(),
        integrator.getExpressionConstraintParameters(0),
    )


def test_it_serializes_as_its_class() -> None:
    integrator = configured()
    integrator.note = "mine"
    expected = (310, 2, 0.003, 1e-6, 11, 65, 123.5, True, 1 | 1 << 3, ("x1 - a", [2], {"a": 0.25}))
    assert settings_of(integrator) == expected
    xml = openmm.XmlSerializer.serialize(integrator)
    assert 'type="VariableStepRattleLangevinIntegrator"' in xml
    for again in (
        XmlSerializer.deserialize(xml),
        Langevin.cast(openmm.XmlSerializer.deserialize(xml)),
        copy.deepcopy(integrator),
        pickle.loads(pickle.dumps(integrator)),
    ):
        assert type(again) is Langevin
        assert settings_of(again) == expected
    assert copy.copy(integrator).note == "mine"
    assert Langevin.isinstance(openmm.XmlSerializer.deserialize(xml))
    assert not VariableStepRattleIntegrator.isinstance(integrator)
    with pytest.raises(TypeError, match="a VerletIntegrator is not a VariableStepRattleLangevinIntegrator"):
        Langevin.cast(openmm.VerletIntegrator(0.001))


def test_what_the_integrators_share_is_had_without_knowing_which_it_is() -> None:
    for integrator in (Langevin(300, 1, 0.001), VariableStepRattleIntegrator(0.001)):
        bare = openmm.XmlSerializer.clone(integrator)
        assert ConstrainedIntegrator.isinstance(bare)
        assert ConstrainedIntegrator.cast(bare).getNumExpressionConstraints() == 0
        assert type(integrator).cast(bare) is bare
        assert type(bare) is type(integrator)
    assert not ConstrainedIntegrator.isinstance(openmm.VerletIntegrator(0.001))


def test_states_of_the_other_integrator_load() -> None:
    system, positions = molecules()
    other = VariableStepRattleIntegrator(0.001)
    source = open_context(copy.deepcopy(system), other, positions)
    other.step(3)
    state = source.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
    context, integrator = make_context()
    context.setState(state)
    integrator.step(1)
    context.loadCheckpoint(source.createCheckpoint())
    assert np.array_equal(state_of(context)[0], state_of(source)[0])
    assert integrator.getTemperature()._value == 300
    integrator.step(1)
    other.step(1)
    source.loadCheckpoint(context.createCheckpoint())
    other.step(1)


# Failures


def test_a_failure_leaves_the_state() -> None:
    """A wall that is no number beyond it: the exception names the particle and k, and the run goes on without it."""
    system, positions = molecules()
    wall = openmm.CustomExternalForce("wall*sqrt(limit - x)")
    wall.addGlobalParameter("wall", 0)
    wall.addGlobalParameter("limit", 0.6)
    wall.addParticle(6, [])
    system.addForce(wall)
    integrator = Langevin(300, 5, 0.004, randomNumberSeed=7)
    integrator.setMaximumSubsteps(9)
    context = open_context(system, integrator, positions)
    integrator.step(2)
    context.setParameter("wall", 1)
    integrator.step(1)
    q, v = state_of(context)
    time, count = context.getTime()._value, context.getStepCount()
    reference = integrator.getReferenceMonitorValue()
    context.setParameter("limit", q[6, 0] + 1e-9)
    v[6] = [3, 0, 0]
    context.setVelocities(v)
    with pytest.raises(openmm.OpenMMException) as caught:
        integrator.step(5)
    message = str(caught.value)
    print(message)
    assert message.startswith(f"VariableStepRattleLangevinIntegrator: the step at t = {time:.10g} ps failed because ")
    for words in ("the force on particle 6 became", "9 substeps (k = 3)", "U was", "state before this step"):
        assert words in message
    after = state_of(context)
    assert np.array_equal(after[0], q)
    assert np.array_equal(after[1], v)
    assert (context.getTime()._value, context.getStepCount()) == (time, count)
    assert integrator.getReferenceMonitorValue() == reference
    context.setParameter("limit", 100)
    integrator.step(5)


def test_a_failure_names_the_cluster() -> None:
    """A chain so fast that its constraints have no solution: the exception has U, k and the particles of the chain."""
    system, positions = molecules()
    integrator = Langevin(300, 5, 0.004, randomNumberSeed=7)
    integrator.setMaximumSubsteps(3)
    context = open_context(system, integrator, positions)
    integrator.step(2)
    q, v = state_of(context)
    time, count = context.getTime()._value, context.getStepCount()
    reference = integrator.getReferenceMonitorValue()
    v[4] += 2000 * np.cross(q[3] - q[4], q[5] - q[4]) / 0.01  # across the bonds
    context.setVelocities(v)
    value = integrator.getMonitorValue()
    with pytest.raises(openmm.OpenMMException) as caught:
        integrator.step(1)
    message = str(caught.value)
    print(message)
    assert message.startswith(f"VariableStepRattleLangevinIntegrator: the step at t = {time:.10g} ps failed because ")
    for words in (
        "in a step of 3 substeps (k = 1)",
        "the hardest being the cluster of the particles 3, 4 and 5",
        "the Context is in the state before this step",
    ):
        assert words in message
    told = re.search(r"the monitor U was (\S+) times its reference value", message)
    assert told is not None
    assert float(told[1]) == pytest.approx(value / reference, rel=1e-4)
    after = state_of(context)
    assert np.array_equal(after[0], q)
    assert np.array_equal(after[1], v)
    assert (context.getTime()._value, context.getStepCount()) == (time, count)
    assert integrator.getReferenceMonitorValue() == reference
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(5)


def test_forces_that_are_no_numbers_at_the_start() -> None:
    system, positions = molecules()
    force = openmm.CustomExternalForce("sqrt(-1 - x^2)")
    force.addParticle(3, [])
    system.addForce(force)
    integrator = Langevin(300, 5, 0.004)
    context = open_context(system, integrator, positions)
    with pytest.raises(openmm.OpenMMException, match="the force on particle 3 is infinite or not a number"):
        integrator.step(1)
    assert np.array_equal(state_of(context)[0], positions)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda i: i.setTemperature(-1), "temperature"),
        (lambda i: i.setTemperature(float("nan")), "temperature"),
        (lambda i: i.setFriction(-0.1), "friction"),
        (lambda i: i.setStepSize(-0.001), "step size"),
        (lambda i: i.setMaximumSubsteps(4), "must be 1, or 2\\^k \\+ 1"),
        (lambda i: i.setMaximumSubsteps(2), "must be 1, or"),
        (lambda i: i.setReferenceMonitorValue(-1), "reference value"),
        (lambda i: i.setConstraintTolerance(0), "constraint tolerance"),
        (lambda i: i.addConstraint("nonsense(", [0]), "cannot be understood"),
        (lambda i: i.getMonitorValue(), "not bound to a context"),
        (lambda i: i.step(1), "not bound to a context"),
        (lambda i: Langevin(-1, 1, 0.001), "temperature"),
        (lambda i: Langevin(300, -1, 0.001), "friction"),
        (lambda i: Langevin(300, 1, -0.001), "step size"),
    ],
)
def test_wrong_values(call: Any, message: str) -> None:
    with pytest.raises(openmm.OpenMMException, match=message) as caught:
        call(Langevin(300, 1, 0.002))
    if "bound" not in message:
        assert str(caught.value).startswith("VariableStepRattleLangevinIntegrator: ")


def test_wrong_types() -> None:
    integrator = Langevin(300, 1, 0.002)
    for call in (
        lambda: Langevin(300 * unit.nanometer, 1, 0.002),
        lambda: Langevin(300, 1 * unit.picosecond, 0.002),
        lambda: integrator.setTemperature("300"),
        lambda: integrator.setRandomNumberSeed(1.5),
        lambda: integrator.freezeReference("yes"),
    ):
        with pytest.raises(TypeError):
            call()


def test_a_step_of_zero_computes_energies_alone() -> None:
    context, integrator = make_context(setStepSize=0)
    assert context.getState(energy=True).getKineticEnergy()._value > 0
    with pytest.raises(openmm.OpenMMException, match="the step size is 0"):
        integrator.step(1)


def test_every_method_is_documented() -> None:
    for each in (ConstrainedIntegrator, Langevin):
        for name, member in vars(each).items():
            if inspect.isfunction(member) and not name.startswith("_"):
                text = inspect.cleandoc(member.__doc__)
                parameters = [p for p in inspect.signature(member).parameters if p != "self"]
                assert all(f"\n{parameter} : " in text for parameter in parameters)
                assert not name.startswith("get") or "Returns\n-------" in text


# Beside other parts of OpenMM


def test_expression_constraints_and_multipliers() -> None:
    """A distance held by an expression moves as one held by the System, and one whose parameter moves follows it."""
    ends = []
    for is_expression in (False, True):
        system = openmm.System()
        for mass in (12.0, 1.0):
            system.addParticle(mass)
        force = openmm.CustomExternalForce("50*((x-0.1)^2+y^2+2*z^2)")
        for i in range(2):
            force.addParticle(i, [])
        system.addForce(force)
        integrator = Langevin(300, 10, 0.004, constraintTolerance=1e-11, randomNumberSeed=2)
        if is_expression:
            integrator.addConstraint("(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-d^2", [0, 1], {"d": 0.1})
        else:
            system.addConstraint(0, 1, 0.1)
        context = openmm.Context(system, integrator, REFERENCE)
        context.setPositions([[0, 0, 0], [0.1, 0, 0]])
        integrator.step(10)
        ends.append((state_of(context)[0], integrator.getMultipliers()._value[0]))
    assert np.allclose(ends[0][0], ends[1][0], atol=1e-9)
    assert ends[0][1] == pytest.approx(ends[1][1], rel=1e-6)
    integrator.setExpressionParameterValue(0, "d", 0.11)
    integrator.step(1)
    q, v = state_of(context)
    assert np.linalg.norm(q[0] - q[1]) == pytest.approx(0.11, rel=1e-8)
    # The velocities belong to the motion along the constraint, of 0.01 nm in a step of 4 fs.
    assert (q[0] - q[1]) @ (v[0] - v[1]) / 0.11 == pytest.approx(0.01 / 0.004, rel=1e-6)


@pytest.mark.parametrize("model", ["tip3p", "tip4pew"])
def test_water_with_a_barostat_and_a_remover_of_motion(model: str) -> None:
    modeller, force_field = solvated(model, 64)
    system = force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.6)
    barostat = openmm.MonteCarloBarostat(1.0, 300, 5)
    barostat.setRandomNumberSeed(5)
    system.addForce(barostat)
    integrator = Langevin(300, 10, 0.002, randomNumberSeed=3)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(fastest_platform()))
    context.setPositions(modeller.positions)
    context.computeVirtualSites()
    volumes, temperatures = set(), []
    for _ in range(40):
        integrator.step(10)
        state = context.getState(energy=True, positions=True)
        volumes.add(state.getPeriodicBoxVolume()._value)
        temperatures.append(state.getKineticEnergy()._value / (0.5 * BOLTZMANN * degrees_of_freedom(system)))
        assert constraint_error(system, numbers(state.getPositions(True))) <= 1e-8 + 1e-13
    assert len(volumes) > 5
    print(f"temperature {np.mean(temperatures[20:]):.0f} K")
    assert 250 < np.mean(temperatures[20:]) < 350


def test_compound_integrator() -> None:
    system, positions = molecules()
    compound = openmm.CompoundIntegrator()
    compound.addIntegrator(Langevin(300, 5, 0.002, randomNumberSeed=4))
    compound.addIntegrator(openmm.VerletIntegrator(0.001))
    context = open_context(system, compound, positions)
    for i in range(6):
        compound.setCurrentIntegrator(i % 2)
        compound.step(3)
    mine = Langevin.cast(compound.getIntegrator(0))
    assert mine.getTemperature()._value == 300
    assert context.getTime()._value == pytest.approx(9 * 0.003)
    q = state_of(context)[0]
    assert constraint_error(system, q) < 1e-5


def test_integrators_of_a_compound_have_noise_of_their_own() -> None:
    """With the same seed too: else two that take turns would use each number twice, and heat."""
    system, positions = molecules()
    compound = openmm.CompoundIntegrator()
    for _ in range(2):
        compound.addIntegrator(Langevin(300, 5, 0.004, randomNumberSeed=7))
    context = open_context(system, compound, positions)
    start = context.getState(positions=True, velocities=True)
    ends = []
    for i in (0, 1):
        context.setState(start)
        compound.setCurrentIntegrator(i)
        compound.step(1)
        ends.append(state_of(context)[0])
        assert Langevin.cast(compound.getIntegrator(i)).getRandomNumberSeed() == 7
    assert np.max(np.abs(ends[0] - ends[1])) > 1e-5
    alone = open_context(copy.deepcopy(system), Langevin(300, 5, 0.004, randomNumberSeed=7), positions)
    alone.setState(start)
    alone.getIntegrator().step(1)
    assert np.array_equal(state_of(alone)[0], ends[0])
    # A checkpoint knows which number is next for each.
    checkpoint = context.createCheckpoint()
    ends = []
    for _ in range(2):
        context.loadCheckpoint(checkpoint)
        for i in (0, 1, 1, 0):
            compound.setCurrentIntegrator(i)
            compound.step(1)
        ends.append(state_of(context)[0])
    assert np.array_equal(ends[0], ends[1])


def test_force_groups() -> None:
    """Without a group its forces do not act."""
    system, positions = molecules()
    system.getForce(0).setForceGroup(2)
    ends = []
    for groups in ({0}, {0, 2}):
        integrator = Langevin(300, 5, 0.002, randomNumberSeed=4)
        integrator.setIntegrationForceGroups(groups)
        context = open_context(copy.deepcopy(system), integrator, positions)
        integrator.step(5)
        ends.append(state_of(context)[0])
    system.removeForce(0)
    integrator = Langevin(300, 5, 0.002, randomNumberSeed=4)
    context = open_context(system, integrator, positions)
    integrator.step(5)
    assert np.allclose(state_of(context)[0], ends[0], atol=1e-9)
    assert np.max(np.abs(ends[0] - ends[1])) > 1e-4


def test_particles_without_mass_stay() -> None:
    system, positions = molecules()
    system.addParticle(0.0)
    for force in (system.getForce(0), system.getForce(1)):
        force.addParticle(0, 0.3, 0.5) if isinstance(force, openmm.NonbondedForce) else force.addParticle(7, [])
    integrator = Langevin(300, 5, 0.002, randomNumberSeed=4)
    context = open_context(system, integrator, [*positions, [0.5, 0.5, 0.5]])
    integrator.step(20)
    assert np.array_equal(state_of(context)[0][7], [0.5, 0.5, 0.5])


def simulation(integrator: openmm.Integrator) -> app.Simulation:
    modeller, force_field = solvated("tip3p", 8)
    system = force_field.createSystem(modeller.topology, nonbondedMethod=app.NoCutoff)
    result = app.Simulation(modeller.topology, system, integrator, REFERENCE)
    result.context.setPositions(modeller.positions)
    result.context.setVelocitiesToTemperature(300, 1)
    return result


def test_simulated_tempering() -> None:
    integrator = Langevin(300, 10, 0.002, randomNumberSeed=1)
    tempering = app.SimulatedTempering(
        simulation(integrator), numTemperatures=4, minTemperature=300, maxTemperature=330, tempChangeInterval=5,
        reportInterval=1000, reportFile=open("/dev/null", "w"),  # noqa: SIM115
    )  # fmt: skip
    seen = set()
    for _ in range(30):
        tempering.step(5)
        seen.add(round(integrator.getTemperature()._value))
    assert len(seen) > 1


def test_replica_exchange_and_expanded_ensemble() -> None:
    states = [{"temperature": t * unit.kelvin} for t in (300, 310, 320)]
    integrator = Langevin(300, 10, 0.002, randomNumberSeed=1)
    replicas = app.ReplicaExchangeSampler(states, simulation(integrator), 5)
    replicas.simulate(4)
    # All go on in one Context, from States; had they the same noise they would come together.
    ends = [numbers(each.getPositions(True)) for each in replicas.replicaConformation]
    assert min(np.max(np.abs(ends[0] - ends[1])), np.max(np.abs(ends[0] - ends[2]))) > 0.01
    assert integrator.getNumForceEvaluations() >= 60
    integrator = Langevin(300, 10, 0.002, randomNumberSeed=1)
    expanded = app.ExpandedEnsembleSampler(states, simulation(integrator), 5)
    expanded.step(20)
    assert integrator.getTemperature()._value in (300, 310, 320)


def test_the_benchmark_of_robustness(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A clash of two waters: ours survives, OpenMM's does not, and the file says so."""
    benchmark = load_script("benchmarks/robustness.py")
    name = "two of eight rigid waters at 0.5 of their diameter, 2 fs"
    arguments = ["--rows", name, "--starts", "1", "--integrators", "ours", "LangevinMiddle", "--output", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    first = capsys.readouterr().out
    assert f"| {name} | 1/1 | 0/1 | 1.0" in first
    assert f"{name}, LangevinMiddle: " in first
    lines = (tmp_path / "robustness.jsonl").read_text().splitlines()
    assert [json.loads(line)["integrator"] for line in lines] == ["control", "ours", "LangevinMiddle"]
    # What has been run is not run again, and a run that is too hot has not survived.
    hot = json.loads(lines[1]) | {"temperature": 900.0}
    (tmp_path / "robustness.jsonl").write_text("\n".join([lines[0], json.dumps(hot), lines[2]]) + "\n")
    assert benchmark.main(arguments) == 0
    assert f"{name}, ours: 900 K at the end, and the control " in capsys.readouterr().out


def test_the_reference_is_set_kept_and_let_go() -> None:
    context, integrator = make_context()
    assert integrator.getReferenceMonitorValue() == 0
    integrator.step(1)
    found = integrator.getReferenceMonitorValue()
    assert found > 0
    integrator.freezeReference(True)
    integrator.step(3)
    assert integrator.getReferenceMonitorValue() == found
    integrator.freezeReference(False)
    integrator.setReferenceMonitorValue(2 * found)
    integrator.step(3)
    assert integrator.getReferenceMonitorValue() == 2 * found
    integrator.setReferenceMonitorValue(0)
    integrator.step(1)
    assert integrator.getReferenceMonitorValue() == pytest.approx(2 * found, rel=0.0021)
    assert integrator.getReferenceMonitorValue() != 2 * found
    assert context.getStepCount() == 8


def test_the_reference_of_small_steps_is_not_that_of_large_ones() -> None:
    """It was the floor, which is far above what is calm for large steps; and would take a thousand of them to fall."""
    context, integrator = make_context(setStepSize=1e-5)
    integrator.step(10)
    small = integrator.getReferenceMonitorValue()
    integrator.setStepSize(0.004)
    integrator.step(1)
    floor = 0.5 * np.sqrt(300 * BOLTZMANN) / 0.004
    assert small == pytest.approx(400 * floor)
    assert integrator.getReferenceMonitorValue() < 1.01 * max(4 * floor, integrator.getMonitorValue()) < small / 2
    # Where it is frozen it stays.
    frozen = integrator.getReferenceMonitorValue()
    integrator.freezeReference(True)
    integrator.setStepSize(1e-5)
    integrator.step(1)
    assert integrator.getReferenceMonitorValue() == frozen
