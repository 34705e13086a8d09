# OpenMM-VRATTLE: stepTo() lands exactly, and the sequence of densities goes on smoothly.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import UPDATES, Array, chain, double_pendulum, open_context, positions_of, time_of, value
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator
from run_support import make_integrator, with_update


def densities(
    step: float, update: str, end: float, interruptions: list[float], bounded: bool
) -> tuple[Array, Array, Array]:
    """Middle, density and size of each step of a run of the chain; interrupted steps are left out."""
    model = chain()
    integrator = with_update(make_integrator(step, setConstraintTolerance=1e-12), update)
    # The scaling of u with time, not with h: so the reference value is the same for every step size.
    integrator.setReferenceMonitorValue(2500.0)
    if not bounded:
        integrator.setMinimumStepSize(0)
        integrator.setMaximumStepSize(0)
    context = open_context(model.system(), integrator, "Reference", model)
    middles, rhos = [], []
    left = list(interruptions)
    while time_of(context) < end:
        before = time_of(context)
        integrator.step(1)
        middles.append((before + time_of(context)) / 2)
        rhos.append(integrator.getStepDensity())
        # The interruption falls somewhere within the next step.
        if left and time_of(context) > left[0]:
            target = time_of(context) + 0.37 * value(integrator.getStepSize())
            integrator.stepTo(target)
            assert time_of(context) == target
            left.pop(0)
    return np.array(middles), np.array(rhos), step / np.array(rhos)


def interpolate(x: Array, y: Array, at: Array) -> Array:
    """By the cubic through the four nearest points."""
    result = np.empty_like(at)
    for n, t in enumerate(at):
        i = int(np.clip(np.searchsorted(x, t) - 2, 0, len(x) - 4))
        nodes, values = x[i : i + 4], y[i : i + 4]
        result[n] = sum(
            values[j] * np.prod([(t - nodes[k]) / (nodes[j] - nodes[k]) for k in range(4) if k != j]) for j in range(4)
        )
    return result


@pytest.mark.parametrize(
    ("update", "bounded"),
    [("SemiExplicit", True), ("SemiExplicit", False), ("Explicit", True), ("Explicit", False), ("Bounded", True)],
)
def test_interruption_disturbs_the_density_in_second_order(update: str, bounded: bool) -> None:
    """What a shortened step does to all later densities goes down by four when the step is halved."""
    begin, end = 0.01, 0.03
    deviations, changes = [], []
    for step in (0.0004, 0.0002, 0.0001):
        alone = densities(step, update, end + 0.002, [], bounded)
        interrupted = densities(step, update, end, [begin], bounded)
        later = interrupted[0] > begin + 2.5 * step
        expected = interpolate(alone[0], alone[1], interrupted[0][later])
        deviations.append(float(np.max(np.abs(interrupted[1][later] / expected - 1))))
        changes.append(float(np.max(alone[1]) / np.min(alone[1])))
    slopes = np.log2(np.array(deviations[:-1]) / np.array(deviations[1:]))
    print(f"{update}, bounded {bounded}: deviations {deviations}, slopes {slopes}, density varies {changes[-1]:.2f}")
    assert changes[-1] > 1.2
    # Second order: 2; the oscillation that the interruption starts depends on where in a step it falls and on how the
    # density goes there, so each slope has a margin. First order would give 1.
    assert slopes.min() > 1.25
    assert np.mean(slopes) > 1.6
    assert deviations[0] < 1e-4


@pytest.mark.parametrize("update", UPDATES)
def test_many_interruptions_do_not_accumulate(update: str) -> None:
    """Frames at equal times, as a reporter by time would ask for: later densities are those of an undisturbed run."""
    step = 0.0002
    alone = densities(step, update, 0.062, [], True)
    interrupted = densities(step, update, 0.06, [0.002 * i for i in range(1, 29)], True)
    later = interrupted[0] > 0.05
    expected = interpolate(alone[0], alone[1], interrupted[0][later])
    deviation = float(np.max(np.abs(interrupted[1][later] / expected - 1)))
    print(f"{update}: {deviation:.1e}")
    # 28 interruptions, each of which alone changes the density by up to 1e-3 (see above), of either sign.
    assert deviation < 5e-3


@pytest.mark.parametrize("update", UPDATES)
def test_exact_landing(update: str, platform: str) -> None:
    """On the very number, for times that are no sums of steps, tiny distances, and far from zero."""
    model = chain()
    integrator = with_update(make_integrator(), update)
    context = open_context(model.system(), integrator, platform, model)
    largest = 0.0
    targets = [1 / 30, 0.04, np.nextafter(0.04, 1), 0.04 + 1e-9, 0.0417, 0.05, 0.0500001, 0.1]
    for target in targets:
        count = context.getStepCount()
        integrator.stepTo(target)
        assert time_of(context) == target
        assert context.getStepCount() > count
        largest = max(largest, value(integrator.getStepSize()))
        # The shortened step is what it was: no longer than its size, and positive.
        assert 0 < value(integrator.getStepSize()) <= 0.001
    context.setTime(1234.5)
    integrator.stepTo(1234.5 + 0.0123)
    assert time_of(context) == 1234.5 + 0.0123
    integrator.stepTo(1234600 * unit.femtoseconds)
    assert time_of(context) == pytest.approx(1234.6, rel=1e-15)
    assert largest > 0


def test_landing_on_the_end_of_a_step() -> None:
    """Where a step ends there anyway, no sliver of a step is added, and none is cut off."""
    for update in UPDATES:
        model = chain()
        runs, end = [], 0.0
        for to_time in (False, True):
            integrator = with_update(make_integrator(), update)
            context = open_context(model.system(), integrator, "Reference", model)
            integrator.step(20)
            if to_time:
                integrator.stepTo(end)
            else:
                integrator.step(10)
                end = time_of(context)
            assert context.getStepCount() == 30
            runs.append(positions_of(context))
            del context
        # The last step of the other is one of plain RATTLE of the same length.
        np.testing.assert_allclose(runs[1], runs[0], rtol=0, atol=1e-7)


def test_energy_error_of_interrupted_runs() -> None:
    """Through the whips of the double pendulum with an interruption every 0.05 ps: the energy stays as good."""
    errors = []
    for interrupted in (False, True):
        model = double_pendulum()
        integrator = VariableStepRattleIntegrator(0.01)
        integrator.setMinimumStepSize(1e-6)
        integrator.setMaximumStepSize(0.02)
        context = open_context(model.system(), integrator, "Reference", model)

        def energy(context: Any = context) -> float:
            state = context.getState(energy=True)
            return state.getKineticEnergy()._value + state.getPotentialEnergy()._value

        start, worst = energy(), 0.0
        for frame in range(1, 81):
            if interrupted:
                integrator.stepTo(0.05 * frame)
                worst = max(worst, abs(energy() - start))
            else:
                while time_of(context) < 0.05 * frame:
                    integrator.step(1)
                    worst = max(worst, abs(energy() - start))
        errors.append(worst)
        del context
    print(f"energy error alone {errors[0]:.1e}, interrupted {errors[1]:.1e} kJ/mol of {abs(start):.0f}")
    # Interrupted runs are not exactly reversible, and so may drift; over 80 frames not beyond the same order.
    assert errors[1] < 10 * errors[0]


def test_a_time_beyond_the_digits_of_a_step() -> None:
    """At 1e15 ps the next number is 0.125 ps away: no step would ever get there."""
    model = chain()
    integrator = make_integrator(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    context.setTime(1e15)
    with pytest.raises(openmm.OpenMMException, match="makes no way at t = 1e"):
        integrator.stepTo(1e15 + 16)
    integrator.stepTo(1e15)
    context.setTime(0)
    integrator.stepTo(0.01)
    assert time_of(context) == 0.01
