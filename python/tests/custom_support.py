# OpenMM-VRATTLE: what the tests of the CustomIntegrator share.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import Array, DenseConstraints, Model, thermal_velocities
from openmmvrattle import CustomVariableStepRattleIntegrator as Custom

# Each platform with each of its precisions. OpenCL on a processor, such as PoCL, will do.
PLATFORMS = [("Reference", "double"), ("CPU", "double")] + [
    (name, precision) for name in ("OpenCL", "CUDA", "HIP") for precision in ("double", "mixed", "single")
]


def platform_parameters(**expected: float) -> list[Any]:
    """Parameters (platform, precision, bound) for the precisions that bounds are given for."""
    return [
        pytest.param(name, precision, expected[precision], id=f"{name}-{precision}")
        for name, precision in PLATFORMS
        if precision in expected
    ]


def open_on(
    platform: str, precision: str, system: openmm.System, integrator: openmm.Integrator, model: Any = None
) -> openmm.Context:
    """A Context in the state of a model, or a skipped test where this machine has no such platform."""
    names = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
    if platform not in names:
        pytest.skip(f"there is no platform {platform} on this machine")
    properties = {"Threads": "1", "DeterministicForces": "true"} if platform == "CPU" else {"Precision": precision}
    properties = {} if platform == "Reference" else properties
    try:
        context = openmm.Context(system, integrator, openmm.Platform.getPlatform(platform), properties)
    except openmm.OpenMMException as error:
        if "device" not in str(error):
            raise
        pytest.skip(f"the platform {platform} has no device here: {error}")
    if model is not None:
        context.setPositions(model.positions)
        context.setVelocities(model.velocities)
    return context


def variable(integrator: Custom, name: str) -> float:
    """A variable of the program."""
    return integrator.getGlobalVariableByName("vrattle_" + name)


def light_molecules(count: int = 4) -> Model:
    """Molecules X-H3, as in a methyl group, whose bonds are fixed: small clusters with one heavy atom, as in
    proteins."""
    rng = np.random.default_rng(3)
    shape = 0.109 * np.array([[0, 0, 0], [0.943, 0, -0.333], [-0.471, 0.816, -0.333], [-0.471, -0.816, -0.333]])
    positions, masses, pairs = [], [], []
    for i in range(count):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        positions.append(np.array([0.33 * i, 0.02 * (i % 2), 0.0]) + shape @ turn.T)
        pairs += [(4 * i, 4 * i + k) for k in (1, 2, 3)]
        masses += [12.011, 1.008, 1.008, 1.008]
    q = np.concatenate(positions)
    lengths = np.array([np.linalg.norm(q[i] - q[j]) for i, j in pairs])

    def forces(system: openmm.System) -> None:
        angle = openmm.HarmonicAngleForce()
        pair = openmm.CustomBondForce("4*0.5*((0.3/r)^12-(0.3/r)^6)")
        for i in range(count):
            for j, k in ((1, 2), (1, 3), (2, 3)):
                angle.addAngle(4 * i + j, 4 * i, 4 * i + k, 1.91, 300.0)
            if i:
                pair.addBond(4 * i - 4, 4 * i, [])
        system.addForce(angle)
        system.addForce(pair)

    constraints = DenseConstraints(masses, pairs, lengths)
    velocities = thermal_velocities(constraints, q.ravel(), 300.0, 5)
    return Model("methyls", np.array(masses), pairs, lengths, q, velocities, 0.001, forces)


def largest(difference: Array) -> float:
    return float(np.max(np.abs(difference)))
