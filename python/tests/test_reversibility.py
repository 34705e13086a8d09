# OpenMM-VRATTLE: a run that is turned round comes back to where it started.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import (
    UPDATES,
    Model,
    chain,
    double_pendulum,
    open_context,
    positions_of,
    ring,
    time_of,
    value,
    velocities_of,
)
from openmmvrattle import VariableStepRattleIntegrator

STEPS = 1000


def there_and_back(
    model: Model, step: float, update: str, tolerance: float, platform: str, steps: int = STEPS
) -> tuple[float, float, float]:
    """The distance from the start after steps, reverse() and steps; the same of -v; and the ratio of step sizes."""
    integrator = VariableStepRattleIntegrator(step)
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    integrator.setConstraintTolerance(tolerance)
    context = open_context(model.system(), integrator, platform, model)
    sizes = []
    for _ in range(steps):
        integrator.step(1)
        sizes.append(value(integrator.getStepSize()))
    turning_point, velocities, time = positions_of(context), velocities_of(context), time_of(context)
    assert np.max(np.abs(turning_point - model.positions)) > 0.05  # It has gone somewhere.
    evaluations = integrator.getNumForceEvaluations()
    integrator.reverse()
    assert integrator.getNumForceEvaluations() == evaluations
    assert np.array_equal(positions_of(context), turning_point)
    assert np.array_equal(velocities_of(context), -velocities)
    assert time_of(context) == time
    for n in range(steps):
        integrator.step(1)
        if n == 0:
            # The step back has the size of the step that would have come next, not of the last one.
            first_back = value(integrator.getStepSize())
    assert integrator.getNumRescues() == 0
    assert time_of(context) > time
    assert first_back > 0
    back = float(np.max(np.abs(positions_of(context) - model.positions)))
    back_velocity = float(np.max(np.abs(velocities_of(context) + model.velocities)))
    return back, back_velocity, max(sizes) / min(sizes)


# What is left is the tolerance of the constraints and rounding, times the growth of small errors along the run: at the
# whip of the pendulum a factor of up to 1e4 for these 1000 steps, in the chain of about 1e2 to 1e3.
@pytest.mark.parametrize("update", UPDATES)
def test_pendulum(update: str, platform: str) -> None:
    position, velocity, ratio = there_and_back(double_pendulum(), 0.005, update, 1e-12, platform)
    assert ratio > 20
    assert position < 1e-8
    assert velocity < 1e-7  # Velocities of a few nm/ps belong to positions of 1 nm.
    position, velocity, _ = there_and_back(double_pendulum(), 0.005, update, 1e-8, platform)
    assert position < 1e-4  # The tolerance is 1e4 times the one above.
    assert velocity < 1e-3


@pytest.mark.parametrize("make", [chain, ring])
@pytest.mark.parametrize("update", UPDATES)
def test_chain_and_ring(make: Callable[[], Model], update: str, platform: str) -> None:
    position, velocity, ratio = there_and_back(make(), 0.0005, update, 1e-12, platform)
    assert ratio > 1.4
    assert position < 1e-9
    assert velocity < 1e-7  # dt is 1e-3 ps, angular frequencies are up to 100/ps.
    position, velocity, _ = there_and_back(make(), 0.0005, update, 1e-8, platform)
    assert position < 1e-5  # The tolerance is 1e4 times the one above.
    assert velocity < 1e-3


@pytest.mark.parametrize("update", UPDATES)
def test_reverse_before_the_first_step_and_twice(update: str) -> None:
    """Turning round twice changes nothing; turning round at once runs the mirrored motion."""
    model = chain()

    def run(turns: int, steps: int = 50) -> tuple[Any, Any]:
        integrator = VariableStepRattleIntegrator(0.0005)
        integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
        integrator.setConstraintTolerance(1e-12)
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.step(steps)
        for _ in range(turns):
            integrator.reverse()
        integrator.step(steps)
        return positions_of(context), velocities_of(context)

    once, straight, twice = run(1), run(0), run(2)
    # Two solutions of one step to the tolerance of 1e-12, and the growth of that error along 50 steps.
    np.testing.assert_allclose(twice[0], straight[0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(twice[1], straight[1], rtol=0, atol=1e-8)
    np.testing.assert_allclose(once[0], model.positions, rtol=0, atol=1e-10)
    assert np.max(np.abs(once[0] - straight[0])) > 1e-3
    mirrored = VariableStepRattleIntegrator(0.0005)
    mirrored.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    mirrored.setReferenceMonitorValue(1000.0)
    context = open_context(model.system(), mirrored, "Reference", model)
    mirrored.reverse()
    # At the start of a run velocities are made tangent to the constraints, which these are up to rounding.
    np.testing.assert_allclose(velocities_of(context), -model.velocities, rtol=0, atol=1e-14)
    mirrored.step(20)
    plain = VariableStepRattleIntegrator(0.0005)
    plain.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    plain.setReferenceMonitorValue(1000.0)
    other = open_context(model.system(), plain, "Reference", model)
    other.setVelocities(-model.velocities)
    plain.step(20)
    # The starting density is the same up to the third difference of U along the motion, which shifts times slightly.
    assert time_of(context) == pytest.approx(time_of(other), rel=1e-3)


def test_better_than_the_error_controlled_integrator() -> None:
    """VariableVerletIntegrator chooses its steps by looking back along the run only, and does not come back."""
    model = chain()
    verlet = openmm.VariableVerletIntegrator(1e-4)
    verlet.setConstraintTolerance(1e-12)
    context = open_context(model.system(), verlet, "Reference", model)
    verlet.step(STEPS)
    middle = time_of(context)
    # Its velocities belong to the middle of the last step; there and back it is best turned half a step further on, so
    # take the better of both ways.
    errors = []
    velocities = velocities_of(context)
    positions = positions_of(context)
    for shift in (0.0, 0.5):
        context.setPositions(positions + shift * value(verlet.getStepSize()) * velocities)
        context.applyConstraints(1e-12)
        context.setVelocities(-velocities)
        start = time_of(context)
        best = np.inf
        while time_of(context) < start + 1.05 * middle:
            verlet.step(1)
            if time_of(context) > start + 0.95 * middle:
                best = min(best, float(np.max(np.abs(positions_of(context) - model.positions))))
        errors.append(best)
    ours = there_and_back(model, 0.0005, "SemiExplicit", 1e-12, "Reference")[0]
    print(f"not back by: VariableVerletIntegrator {min(errors):.2e} nm, VariableStepRattleIntegrator {ours:.2e} nm")
    assert min(errors) > 1e3 * ours
