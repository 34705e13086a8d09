# OpenMM-VRATTLE: constraints met to the tolerance, and multipliers that are the constraint forces.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import openmm
import pytest
from dense_reference import (
    DenseConstraints,
    Model,
    chain,
    open_context,
    positions_of,
    ring,
    time_of,
    value,
    velocities_of,
    waters,
    whip,
)
from openmmvrattle import VariableStepRattleIntegrator


@pytest.mark.parametrize("tolerance", [1e-5, 1e-8, 1e-12])
def test_light_atom_between_heavy_ones(tolerance: float, platform: str) -> None:
    """Two strongly coupled bonds: an iterative solver that treats them nearly independently does not get there."""
    model = whip()
    c = model.constraints()
    # About 11 ps, with steps of up to 0.02 ps; the three particles come into line at 2.1 ps for the first time.
    integrator = VariableStepRattleIntegrator(0.01)
    integrator.setConstraintTolerance(tolerance)
    assert integrator.getConstraintTolerance() == tolerance
    context = open_context(model.system(), integrator, platform, model)
    worst = 0.0
    for _ in range(2000):
        integrator.step(1)
        q, v = positions_of(context).ravel(), velocities_of(context).ravel()
        worst = max(worst, float(np.max(np.abs(c.relative_errors(q)))))
        # The velocity constraints are linear: solved to rounding whatever the tolerance.
        assert np.max(np.abs(c.jacobian(q) @ v)) < 1e-12
    assert worst <= tolerance
    assert time_of(context) > 10
    verlet = openmm.VerletIntegrator(0.005)
    verlet.setConstraintTolerance(tolerance)
    other = open_context(model.system(), verlet, platform, model)
    theirs = 0.0
    for _ in range(2000):
        verlet.step(1)
        theirs = max(theirs, float(np.max(np.abs(c.relative_errors(positions_of(other).ravel())))))
    print(f"tolerance {tolerance:.0e}: largest error {worst:.1e}, VerletIntegrator {theirs:.1e}")
    assert theirs > 1e-4


@pytest.mark.parametrize("make", [chain, ring, waters])
@pytest.mark.parametrize("tolerance", [1e-5, 1e-8, 1e-12])
def test_tolerances(tolerance: float, make: Callable[[], Model], platform: str) -> None:
    model = make()
    c = model.constraints()
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.setConstraintTolerance(tolerance)
    context = open_context(model.system(), integrator, platform, model)
    for _ in range(200):
        integrator.step(1)
        # Rounding of |r|: positions up to 1 nm from the origin.
        assert np.max(np.abs(c.relative_errors(positions_of(context).ravel()))) <= tolerance + 1e-14


def test_tighter_tolerance_takes_more_iterations() -> None:
    counts = []
    for tolerance in (1e-4, 1e-8, 1e-12):
        model = chain()
        integrator = VariableStepRattleIntegrator(0.001)
        integrator.setConstraintTolerance(tolerance)
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.step(200)
        counts.append(integrator.getNumSolverIterations())
        del context
    assert 200 <= counts[0] < counts[1] < counts[2]


def test_step_restores_constraints_of_an_inexact_start() -> None:
    """Positions read from a file are rounded: the first step puts that right."""
    model = chain()
    c = model.constraints()
    integrator = VariableStepRattleIntegrator(0.0005)
    context = open_context(model.system(), integrator, "Reference", model)
    context.setPositions(np.round(model.positions, 4))
    assert np.max(np.abs(c.relative_errors(np.round(model.positions, 4).ravel()))) > 1e-5
    integrator.step(1)
    assert np.max(np.abs(c.relative_errors(positions_of(context).ravel()))) <= 1e-8


def hanging_chain(masses: list[float], lengths: list[float], gravity: float) -> Model:
    """A chain at rest below a pivot."""
    heights = -np.concatenate([[0.0], np.cumsum(lengths)])

    def forces(system: openmm.System) -> None:
        force = openmm.CustomExternalForce(f"{gravity}*w*z")
        force.addPerParticleParameter("w")
        for i, mass in enumerate(masses):
            force.addParticle(i + 1, [mass])
        system.addForce(force)

    count = len(masses)
    # Every other bond is written the other way round: the sign of a multiplier does not depend on it.
    pairs = [(i, i + 1) if i % 2 == 0 else (i + 1, i) for i in range(count)]
    q = np.stack([np.zeros(count + 1), np.zeros(count + 1), heights], axis=1)
    return Model(
        "hanging", np.array([1e15, *masses]), pairs, np.array(lengths), q, np.zeros((count + 1, 3)), 0.001, forces
    )


def test_multipliers_are_tensions(platform: str) -> None:
    """Statics: the tension 2 Lambda d of each bond is the weight of what hangs below it, in kJ/mol/nm."""
    masses, lengths, gravity = [3.0, 1.0, 20.0, 7.0], [0.1, 0.25, 0.15, 0.4], 9.5
    model = hanging_chain(masses, lengths, gravity)
    integrator = VariableStepRattleIntegrator(0.001)
    context = open_context(model.system(), integrator, platform, model)
    weight_below = gravity * np.cumsum(masses[::-1])[::-1]
    for _ in range(3):
        tension = 2 * np.array([value(x) for x in integrator.getMultipliers()]) * np.array(lengths)
        # Solved to rounding; the pivot's mass of 1e15 adds 1e-14.
        np.testing.assert_allclose(tension, weight_below, rtol=1e-10)
        integrator.step(50)
    np.testing.assert_allclose(positions_of(context), model.positions, rtol=0, atol=1e-9)
    expected = np.linalg.norm(weight_below / (2 * np.array(lengths)))
    assert value(integrator.getMonitorValue(0)) == pytest.approx(expected, rel=1e-10)


def test_multipliers_of_a_rotor_and_of_compression(platform: str) -> None:
    """A spinning dumbbell pulls on its bond with mu v^2/d, v the relative speed; a push from both ends subtracts."""
    masses, distance, speed = [4.0, 12.0], 0.2, 1.7
    reduced = 3.0
    system = openmm.System()
    for mass in masses:
        system.addParticle(mass)
    system.addConstraint(0, 1, distance)
    push = openmm.CustomExternalForce("f*x")
    push.addPerParticleParameter("f")
    push.addParticle(0, [-30.0])
    push.addParticle(1, [30.0])
    push.setForceGroup(1)
    system.addForce(push)
    for groups, applied in (({0}, 0.0), ({1}, 30.0)):
        integrator = VariableStepRattleIntegrator(0.0001)
        integrator.setIntegrationForceGroups(groups)
        context = open_context(system, integrator, platform)
        context.setPositions([[0, 0, 0], [distance, 0, 0]])
        context.setVelocities([[0, -speed * 0.75, 0], [0, speed * 0.25, 0]])
        tension = 2 * value(integrator.getMultipliers()[0]) * distance
        # The force is +30 on particle 0 at x = 0 and -30 on the other: they are pushed together.
        assert tension == pytest.approx(reduced * speed**2 / distance - applied, rel=1e-12)
        integrator.step(1)


def test_constraint_force_completes_newtons_law(platform: str) -> None:
    """F - G^T Lambda is mass times acceleration: checked against second differences of the trajectory."""
    model = chain()
    c: DenseConstraints = model.constraints()
    step = 1e-5
    integrator = VariableStepRattleIntegrator(step)
    integrator.clearMonitors()
    integrator.setConstraintTolerance(1e-13)
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(1)
    before = velocities_of(context).ravel()
    integrator.step(1)
    lam = np.array([value(x) for x in integrator.getMultipliers()])
    state = context.getState(positions=True, forces=True)
    q = state.getPositions(asNumpy=True)._value.ravel()
    total = state.getForces(asNumpy=True)._value.ravel() - c.jacobian(q).T @ lam
    integrator.step(1)
    acceleration = (velocities_of(context).ravel() - before) / (2 * step)
    # Central differences: (omega dt)^2 with omega up to 500/ps is 2.5e-5; velocities are known to 1e-13/dt.
    np.testing.assert_allclose(c.m3 * acceleration, total, rtol=0, atol=1e-4 * np.max(np.abs(total)))
