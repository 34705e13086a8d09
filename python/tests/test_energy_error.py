# OpenMM-VRATTLE: the leading energy error of RATTLE, on which automatic step control rests.
# SPDX-License-Identifier: MIT

"""With fixed steps dt the energy along a trajectory differs from that at its start by

    -dt^2 [H2(t) - H2(0)] + O(dt^4),      H2 = V''/12 + |a|^2/24,

where V'' is the second time derivative of the potential energy along the motion, v.(d^2V/dq^2)v + dV/dq.a, and |a|^2
the mass-weighted square of the acceleration a of the constrained motion. Checked in NumPy, with finite differences.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from dense_reference import Model, chain, energy_of, open_context, positions_of, ring, velocities_of, waters, whip
from openmmvrattle import VariableStepRattleIntegrator


def second_term(model: Model, q: np.ndarray, v: np.ndarray) -> float:
    """H2 at a state."""
    c, potential = model.constraints(), model.potential()
    q, v = q.ravel(), v.ravel()
    gradient = potential(q)[1]
    acceleration = c.w3 * (-gradient - c.jacobian(q).T @ c.multipliers(q, c.m3 * v, gradient))
    size = 1e-5 / np.max(np.abs(v))  # nm
    curvature = v @ (potential(q + size * v)[1] - potential(q - size * v)[1]) / (2 * size)
    return (curvature + gradient @ acceleration) / 12 + c.m3 @ acceleration**2 / 24


@pytest.mark.parametrize(
    "make, step, largest_rest", [(chain, 1e-4, 2e-3), (waters, 1e-4, 2e-3), (ring, 1e-4, 2e-3), (whip, 2e-4, 2e-3)]
)
def test_leading_energy_error(make: Callable[[], Model], step: float, largest_rest: float) -> None:
    model = make()
    integrator = VariableStepRattleIntegrator(step, monitors=[], constraintTolerance=1e-13)
    context = open_context(model.system(), integrator, "Reference", model)
    start, first = energy_of(context), second_term(model, model.positions, model.velocities)
    errors, predicted = [], []
    for _ in range(60):
        integrator.step(10)
        errors.append(energy_of(context) - start)
        predicted.append(-(step**2) * (second_term(model, positions_of(context), velocities_of(context)) - first))
    rest = float(np.max(np.abs(np.array(errors) - predicted)) / np.max(np.abs(errors)))
    print(f"{model.name}: energy error {np.max(np.abs(errors)):.2e} kJ/mol, {rest:.1e} of it is not -dt^2 (H2 - H2(0))")
    assert rest < largest_rest
