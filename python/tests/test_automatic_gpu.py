# OpenMM-VRATTLE: automatic step control on a GPU platform against Reference.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import openmm
import pytest
from dense_reference import Array
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import TestSystem, light_heavy_chain, nitrogen_collision, water_clash
from run_support import GPU, needs_gpu

pytestmark = needs_gpu

STATE = {"positions": True, "velocities": True, "parameters": True, "integratorParameters": True}


def open_run(case: TestSystem, platform: str, step: float) -> openmm.Context:
    integrator = VariableStepRattleIntegrator(step, automatic=True, constraintTolerance=1e-12)
    properties = {"Precision": "double"} if platform == GPU else {}
    context = openmm.Context(case.system, integrator, openmm.Platform.getPlatform(platform), properties)
    context.setPositions(case.positions)
    context.setVelocities(case.velocities)
    return context


def positions_of(context: openmm.Context) -> Array:
    return np.array(context.getState(positions=True).getPositions(asNumpy=True)._value)


def energy_of(context: openmm.Context) -> float:
    state = context.getState(energy=True)
    return float((state.getPotentialEnergy() + state.getKineticEnergy())._value)


# A system, a nominal step with which it needs shorter ones, the steps before the two runs part, those that they then
# have in common, and how far apart they may be after these (nm). OpenMM computes nonbonded forces on GPUs that differ
# by 3e-7 from those on Reference, and a collision makes that larger; in the whip there are none.
CASES = {
    "whip": (light_heavy_chain, 1.25e-3, 1600, 300, 1e-9),
    "clash": (water_clash, 2e-3, 20, 200, 1e-5),
    "N2": (nitrogen_collision, 2e-3, 80, 200, 1e-6),
}


@pytest.mark.parametrize("name", CASES)
def test_the_steps_are_those_of_reference(name: str) -> None:
    """From a State in mid-run: positions, step sizes and monitors, after one step and after some hundred.

    So the energy error, and with it the gain over fixed steps, is the same.
    """
    make, step, before, steps, bound = CASES[name]
    case = make()
    there, here = open_run(case, "Reference", step), open_run(case, GPU, step)
    there.getIntegrator().step(before)
    here.setState(there.getState(**STATE))
    energy = energy_of(there)
    densities: dict[openmm.Context, list[float]] = {there: [], here: []}
    for context in (there, here):
        context.getIntegrator().step(1)
    assert np.abs(positions_of(here) - positions_of(there)).max() <= 1e-9
    for context, found in densities.items():
        integrator = context.getIntegrator()
        for _ in range(steps // 10):
            integrator.step(10)  # nothing is read within
            found.append(integrator.getStepDensity())
    assert np.abs(positions_of(here) - positions_of(there)).max() <= bound
    np.testing.assert_allclose(densities[here], densities[there], rtol=1e-4)
    assert max(densities[there]) > 1.5  # the steps did become shorter
    ours, others = here.getIntegrator(), there.getIntegrator()
    for monitor in range(2):
        reference = others.getReferenceMonitorValue(monitor)
        assert ours.getReferenceMonitorValue(monitor) == pytest.approx(reference, rel=1e-6)
        assert ours.getMonitorValue(monitor) == pytest.approx(others.getMonitorValue(monitor), rel=1e-3)
    error = energy_of(there) - energy
    assert energy_of(here) - energy == pytest.approx(error, abs=1e-3 * abs(error) + 1e-6 * abs(energy))
    assert ours.getNumForceEvaluations() == steps // 10 * 10 + 2


def test_a_run_moves_between_platforms_and_comes_back() -> None:
    """A State goes to the GPU and back, there time is turned around, and all ends where it was before."""
    case = nitrogen_collision()
    make: Callable[[str], openmm.Context] = lambda on: open_run(case, on, 2e-3)  # noqa: E731
    runs = [make(on) for on in ("Reference", GPU, "Reference", GPU)]
    start = None
    for last, run in zip([None, *runs[:-1]], runs, strict=True):
        if last is not None:
            run.setState(last.getState(**STATE))
        run.getIntegrator().step(70)
        start = positions_of(run) if start is None else start
    for last, run in zip([None, *runs[:0:-1]], runs[:0:-1], strict=False):
        if last is not None:
            run.setState(last.getState(**STATE))
        else:
            run.getIntegrator().reverse()
        run.getIntegrator().step(70)
    # OpenMM computes nonbonded forces that differ by 3e-7 between the two.
    assert np.abs(positions_of(runs[1]) - start).max() <= 1e-8
