# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The precision of a device: what it allows, and what double precision is good for."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import openmm
import pytest
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.platforms import make_context
from openmmvrattle.testsystems import constraint_error, project_onto_constraints, rigid_waters
from run_support import GPU, needs_gpu

pytestmark = needs_gpu

TOLERANCES = """
import sys
import openmm
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.platforms import make_context
from openmmvrattle.testsystems import constraint_error, rigid_waters

waters = rigid_waters(4)
for _ in range(2):
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.setConstraintTolerance(float(sys.argv[2]))
    context = make_context(waters.system, integrator, f"{sys.argv[3]}:{sys.argv[1]}")
    context.setPositions(waters.positions)
    context.setVelocities(waters.velocities)
    integrator.step(20)
    assert integrator.isOnDevice()
    state = context.getState(positions=True)
    print("error", constraint_error(waters.system, state.getPositions(asNumpy=True)._value))
    print("set", integrator.getConstraintTolerance())
"""


@pytest.mark.parametrize(
    ("precision", "tolerance", "floor"),
    [("single", "1e-8", "1e-05"), ("mixed", "1e-14", "1e-12"), ("mixed", "1e-10", None), ("double", "1e-12", None)],
)
def test_a_tolerance_that_cannot_be_met_is_raised(precision: str, tolerance: str, floor: str | None) -> None:
    """It is said once in a process, on the standard error, and the constraints are met to what is used."""
    result = subprocess.run(
        [sys.executable, "-c", TOLERANCES, precision, tolerance, GPU], check=True, capture_output=True, text=True
    )
    said = [line for line in result.stderr.splitlines() if "constraint tolerance" in line]
    words = f"{float(tolerance):g} is below what the precision of this Context allows; {floor} is used"
    assert (len(said) == 1 and words in said[0]) if floor else not said
    lines = [line.split() for line in result.stdout.splitlines() if line.startswith(("error ", "set "))]
    assert [float(value) for name, value in lines if name == "set"] == [float(tolerance)] * 2
    errors = [float(value) for name, value in lines if name == "error"]
    assert len(errors) == 2
    # Positions in float have themselves an error of 1e-7 of the size of a bond.
    assert max(errors) < float(floor or tolerance) * (1.1 if precision == "single" else 1.01)


def test_multipliers_in_double_precision_are_those_of_reference() -> None:
    """To 1e-10, with forces that agree to rounding: springs to points, and between next neighbours but one.

    OpenMM's devices keep the parameters of Forces in single precision, so these are numbers that float has.
    """
    random = np.random.default_rng(3)
    beads = 40
    system = openmm.System()
    positions = np.zeros((beads, 3))
    positions[1:] = np.cumsum([[0.1, 0.06 * (-1) ** i, 0.03 * np.sin(i)] for i in range(beads - 1)], axis=0)
    field = openmm.CustomExternalForce("300*((x-x0)^2+(y-y0)^2+(z-z0)^2)")
    for name in ("x0", "y0", "z0"):
        field.addPerParticleParameter(name)
    springs = openmm.HarmonicBondForce()
    for i in range(beads):
        system.addParticle(random.uniform(1, 20))
        field.addParticle(i, np.float32(positions[i] + random.normal(size=3) * 0.05).astype(float))
        if i > 0:
            # Small clusters at the one end, a large one at the other.
            if i > beads // 2 or i % 4:
                system.addConstraint(i - 1, i, np.linalg.norm(positions[i] - positions[i - 1]))
        if i > 1:
            springs.addBond(i - 2, i, 0.1875, 5000)
    system.addForce(field)
    system.addForce(springs)
    positions, velocities = project_onto_constraints(system, positions, random.normal(size=(beads, 3)))
    found = {}
    for name in ("Reference", f"{GPU}:double"):
        integrator = VariableStepRattleIntegrator(0.0005)
        integrator.setConstraintTolerance(1e-12)
        context = make_context(system, integrator, name)
        context.setPositions(positions)
        context.setVelocities(velocities)
        integrator.step(25)
        assert integrator.isOnDevice() == (name != "Reference")
        values = [integrator.getMonitorValue(), integrator.getStepDensity()]
        multipliers = np.array(integrator.getMultipliers().value_in_unit(unit.kilojoule_per_mole / unit.nanometer**2))
        state = context.getState(positions=True)
        assert constraint_error(system, state.getPositions(asNumpy=True)._value) < 1e-12
        found[name] = values, multipliers
    (expected, forces), (values, here) = found.values()
    assert np.max(np.abs(forces)) > 100
    assert np.max(np.abs(here - forces)) < 1e-10 * np.max(np.abs(forces))
    # The monitor is the norm of the multipliers, which the device computes itself.
    np.testing.assert_allclose(values, expected, rtol=1e-10)


def turning_zigzag(platform: str, steps_at_once: int) -> tuple[np.ndarray, list[bool]]:
    """A zigzag of 24 bonds that turn by up to half a radian in a step: the chord iteration does not contract there."""
    system = openmm.System()
    places = np.arange(25)
    for place in places:
        system.addParticle(12.0)
        if place > 0:
            system.addConstraint(place - 1, place, 0.15)
    integrator = VariableStepRattleIntegrator(0.001, constraintTolerance=1e-10)
    integrator.clearMonitors()
    context = make_context(system, integrator, platform)
    velocities = np.zeros((25, 3))
    velocities[1:, 2] = np.where(places[1:] % 4 < 2, 31.0, -31.0)
    context.setPositions(np.stack([0.12 * (places - 12), 0.09 * (places % 2), 0.0 * places], axis=1))
    context.setVelocities(velocities)
    are_on_device = []
    for _ in range(4 // steps_at_once):
        integrator.step(steps_at_once)
        are_on_device.append(integrator.isOnDevice())
    assert context.getStepCount() == 4
    return context.getState(positions=True).getPositions(asNumpy=True)._value, are_on_device


@pytest.mark.skipif(GPU != "OpenCL", reason="with others it has not been tried")
def test_several_devices() -> None:
    """Two that share the forces, here one taken twice: the steps are the first one's, and the run is the same."""
    waters = rigid_waters()
    positions, densities = [], []
    for devices in ("0", "0,0"):
        integrator = VariableStepRattleIntegrator(0.001)
        properties = {"Precision": "double", "DeviceIndex": devices}
        context = openmm.Context(waters.system, integrator, openmm.Platform.getPlatform(GPU), properties)
        assert context.getPlatform().getPropertyValue(context, "DeviceIndex") == devices
        context.setPositions(waters.positions)
        context.setVelocities(waters.velocities)
        integrator.step(20)
        context.loadCheckpoint(context.createCheckpoint())
        integrator.step(10)
        assert integrator.isOnDevice()
        positions.append(context.getState(positions=True).getPositions(asNumpy=True)._value)
        densities.append(integrator.getStepDensity())
    assert np.max(np.abs(positions[0] - positions[1])) < 1e-9
    assert densities[0] == pytest.approx(densities[1], rel=1e-9)
    assert abs(densities[0] - 1) > 0.01


@pytest.mark.parametrize("steps_at_once", [1, 4])
def test_newtons_iteration_of_a_large_cluster_is_the_devices(steps_at_once: int) -> None:
    """The start is the host's; the steps after it stay on the device, those that it takes again among them."""
    expected, _ = turning_zigzag("Reference", 1)
    positions, are_on_device = turning_zigzag(f"{GPU}:double", steps_at_once)
    assert are_on_device == ([False, True, True, True] if steps_at_once == 1 else [True])
    np.testing.assert_allclose(positions, expected, rtol=0, atol=1e-9)
