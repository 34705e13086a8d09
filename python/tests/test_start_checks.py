# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What is refused before it goes wrong without a word, and velocities to start with, as scripts meet them."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pytest
from dense_reference import positions_of, waters
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator, constraints, testsystems
from run_support import GPU, needs_gpu

KB = 0.00831446261815324
"""Boltzmann's constant in kJ/mol/K."""


def open_context(system: openmm.System, integrator: openmm.Integrator, positions: object = None) -> openmm.Context:
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    if positions is not None:
        context.setPositions(positions)
    return context


def wrapped_waters() -> tuple[openmm.System, np.ndarray, np.ndarray]:
    """Rigid waters in a box with each particle wrapped into it by itself, as some programs write frames."""
    test = testsystems.peptide_in_water()
    positions = np.array(test.positions)
    box = np.array([v.value_in_unit(unit.nanometer) for v in test.system.getDefaultPeriodicBoxVectors()])
    shifted = positions + 0.31 * np.diag(box)
    return test.system, shifted, shifted - np.floor(shifted / np.diag(box)) * np.diag(box)


def test_a_frame_wrapped_particle_by_particle() -> None:
    system, whole, wrapped = wrapped_waters()
    torn = [
        (i, j)
        for i, j, length in (system.getConstraintParameters(k) for k in range(system.getNumConstraints()))
        if np.linalg.norm(wrapped[i] - wrapped[j]) > 2 * length._value
    ]
    assert torn
    integrator = VariableStepRattleIntegrator(0.001, monitors=[])
    context = open_context(system, integrator, wrapped)
    with pytest.raises(openmm.OpenMMException, match="molecules must be whole") as error:
        integrator.step(1)
    assert any(f"between the particles {i} and {j} is" in str(error.value) for i, j in torn)
    state = context.getState(positions=True)
    assert np.array_equal(state.getPositions(asNumpy=True)._value, wrapped)
    context.setPositions(whole)
    integrator.step(1)


def test_velocities_of_a_temperature() -> None:
    """The mean energy per degree of freedom, with expressions, on a molecule that OpenMM's solver is no help for."""
    system = openmm.System()
    corners = 0.14 * np.array([[math.cos(k * math.pi / 3), math.sin(k * math.pi / 3), 0] for k in range(6)])
    for _ in range(6):
        system.addParticle(13.019)
    for i, j in [(k, (k + 1) % 6) for k in range(6)] + [(0, 2), (0, 3), (0, 4)]:
        system.addConstraint(i, j, float(np.linalg.norm(corners[i] - corners[j])))
    integrator = VariableStepRattleIntegrator(0.0005, monitors=[])
    constraints.fix_center_of_mass(integrator, system, [0, 0, 0])
    context = open_context(system, integrator, corners)
    energies = []
    for seed in range(1, 301):
        integrator.setVelocitiesToTemperature(27 * unit.kelvin, seed)
        state = context.getState(energy=True, velocities=True)
        energies.append(state.getKineticEnergy()._value)
        v = state.getVelocities(asNumpy=True)._value
        assert np.abs(v.sum(axis=0)).max() < 1e-13
        for k in range(system.getNumConstraints()):
            i, j, _ = system.getConstraintParameters(k)
            assert abs((corners[i] - corners[j]) @ (v[i] - v[j])) < 1e-13
    freedom = 18 - 9 - 3
    assert np.mean(energies) == pytest.approx(0.5 * freedom * KB * 27, rel=4 * math.sqrt(2 / freedom / 300))


def test_seeds_and_arguments() -> None:
    test = testsystems.light_heavy_chain()
    integrator = VariableStepRattleIntegrator(0.001)
    context = open_context(test.system, integrator, test.positions)

    def velocities(*arguments: object, **keywords: object) -> np.ndarray:
        integrator.setVelocitiesToTemperature(*arguments, **keywords)
        return context.getState(velocities=True).getVelocities(asNumpy=True)._value

    assert np.array_equal(velocities(300, 4), velocities(300 * unit.kelvin, randomSeed=4))
    assert not np.array_equal(velocities(300), velocities(300))
    np.testing.assert_allclose(velocities(1200, 4), 2 * velocities(300, 4), rtol=1e-9, atol=1e-12)
    with pytest.raises(TypeError, match="randomSeed"):
        integrator.setVelocitiesToTemperature(300, 1.5)
    with pytest.raises(TypeError, match="temperature"):
        integrator.setVelocitiesToTemperature(300 * unit.nanometer)
    with pytest.raises(openmm.OpenMMException, match="the temperature must be a finite number of kelvins"):
        integrator.setVelocitiesToTemperature(-300)


@pytest.mark.parametrize("platform", ["Reference", pytest.param(GPU, marks=needs_gpu)])
def test_velocities_that_are_refused_leave_no_trace(platform: str) -> None:
    """The run goes on with its density, as if they had never been asked for; on a GPU too, where it had stepped."""
    model = waters()
    ends = []
    for temperature in (None, 1e30):
        integrator = VariableStepRattleIntegrator(0.0005)
        context = openmm.Context(model.system(), integrator, openmm.Platform.getPlatformByName(platform))
        context.setPositions(model.positions)
        context.setVelocities(model.velocities)
        integrator.step(6)
        assert integrator.isOnDevice() == (platform != "Reference")
        if temperature is not None:
            with pytest.raises(openmm.OpenMMException, match="faster than light"):
                integrator.setVelocitiesToTemperature(temperature, 1)
        integrator.step(6)
        ends.append((positions_of(context), integrator.getStepDensity()))
    allowed = 0 if platform == "Reference" else 1e-12
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=0, atol=allowed)
    assert abs(ends[0][1] - ends[1][1]) <= allowed


def test_velocities_that_are_refused_leave_no_trace_in_other_integrators() -> None:
    """Those of the same CompoundIntegrator were told of new velocities, too."""
    model = waters()
    ends = []
    for is_asked in (False, True):
        compound, members = openmm.CompoundIntegrator(), []
        for _ in range(2):
            members.append(VariableStepRattleIntegrator(0.0005))
            compound.addIntegrator(members[-1])
        context = open_context(model.system(), compound, model.positions)
        context.setVelocities(model.velocities)
        for turn in range(4):
            compound.setCurrentIntegrator(turn % 2)
            if is_asked and turn == 2:
                with pytest.raises(openmm.OpenMMException, match="faster than light"):
                    members[0].setVelocitiesToTemperature(1e30, 1)
            compound.step(6)
        ends.append((positions_of(context), [member.getStepDensity() for member in members]))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1]


def test_three_particles_in_a_line() -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    with pytest.raises(ValueError, match=r"x2 - 0.5\*\(x1\+x3\).*docs/constraints.md, molecules in a line"):
        constraints.fix_angle(integrator, 0, 1, 2, math.pi)
    system = openmm.System()
    for _ in range(3):
        system.addParticle(12.0)
    for i, j, length in ((0, 1, 0.116), (1, 2, 0.116), (0, 2, 0.232)):
        system.addConstraint(i, j, length)
    context = open_context(system, integrator, [[-0.116, 0, 0], [0, 0, 0], [0.116, 0, 0]])
    with pytest.raises(openmm.OpenMMException, match=r"0, 1 and 2 keep them in a line.*x2 - 0.5\*\(x1\+x3\)"):
        integrator.step(1)
    assert context.getTime()._value == 0


@pytest.mark.parametrize("monitors", [[], None], ids=["fixed steps", "a monitor"])
def test_a_rotor_held_in_a_line(monitors: list[int] | None) -> None:
    """A linear rotor in a uniform field against the equation of motion of its angle."""
    oxygen, carbon, r, field, charges = 15.9994, 12.011, 0.116, 40.0, (1.0, -1.5, 0.5)
    system = openmm.System()
    force = openmm.CustomExternalForce(f"{field}*y*q")
    force.addPerParticleParameter("q")
    for i, (mass, charge) in enumerate(zip((oxygen, carbon, oxygen), charges, strict=True)):
        system.addParticle(mass)
        force.addParticle(i, [charge])
    system.addForce(force)
    system.addConstraint(0, 2, 2 * r)
    integrator = VariableStepRattleIntegrator(0.0005, monitors=monitors)
    for axis in "xyz":
        integrator.addConstraint(f"{axis}2 - 0.5*({axis}1 + {axis}3)", [0, 1, 2])
    context = open_context(system, integrator, [[-r, 0, 0], [0, 0, 0], [r, 0, 0]])
    omega = 3.0
    context.setVelocities([[0, -omega * r, 0], [0, 0, 0], [0, omega * r, 0]])
    integrator.stepTo(1.0)
    # I theta'' = -field (sum of charge times place) cos theta, by the midpoint of many small steps.
    inertia, dipole = 2 * oxygen * r * r, sum(q * x for q, x in zip(charges, (-r, 0, r), strict=True))
    theta, h = 0.0, 1.0 / 100000
    for _ in range(100000):
        omega -= 0.5 * h * field * dipole * math.cos(theta) / inertia
        theta += h * omega
        omega -= 0.5 * h * field * dipole * math.cos(theta) / inertia
    x = context.getState(positions=True).getPositions(asNumpy=True)._value
    angle = math.atan2(*(x[2] - x[0])[1::-1])
    assert math.remainder(angle - theta, 2 * math.pi) == pytest.approx(0, abs=2e-5)
    np.testing.assert_allclose(x[1], (x[0] + x[2]) / 2, rtol=0, atol=1e-9)
