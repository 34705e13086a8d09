# OpenMM-VRATTLE: in a CompoundIntegrator with VerletIntegrator.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import chain, energy_of, open_context, positions_of, time_of, value, velocities_of
from openmmvrattle import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator
from openmmvrattle.testsystems import constraint_error
from run_support import assert_same_run, make_integrator


def make_compound(step: float, ours_first: bool) -> tuple[Any, VariableStepRattleIntegrator, Any, int, int]:
    """The CompoundIntegrator, its members, and their indices in it."""
    ours = make_integrator(step, setConstraintTolerance=1e-10)
    verlet = openmm.VerletIntegrator(step)
    verlet.setConstraintTolerance(1e-10)
    compound = openmm.CompoundIntegrator()
    members = [ours, verlet] if ours_first else [verlet, ours]
    indices = [compound.addIntegrator(member) for member in members]
    assert indices == [0, 1]
    return compound, ours, verlet, members.index(ours), members.index(verlet)


def power_of(context: openmm.Context) -> float:
    """What the forces do, sum F v, in kJ/mol/ps; those of the constraints do nothing."""
    state = context.getState(velocities=True, forces=True)
    return float(np.sum(state.getForces(asNumpy=True)._value * state.getVelocities(asNumpy=True)._value))


def switching_jumps(step: float, ours_first: bool, platform: str) -> list[tuple[float, float]]:
    """(jump of the energy, what half a step explains of it) of each switch."""
    model = chain()
    compound, ours, verlet, our_index, verlet_index = make_compound(step, ours_first)
    context = open_context(model.system(), compound, platform, model)
    jumps = []
    order = [our_index, verlet_index] if ours_first else [verlet_index, our_index]
    time = 0.0
    for leg in range(8):
        previous = energy_of(context)
        compound.setCurrentIntegrator(order[leg % 2])
        assert compound.getCurrentIntegrator() == order[leg % 2]
        # VerletIntegrator takes velocities to be of half a step earlier than the positions and shows its energy
        # accordingly, so the same numbers stand for other energies.
        sign = 1 if order[leg % 2] == verlet_index else -1
        expected = sign * power_of(context) * value(verlet.getStepSize()) / 2
        if leg > 0:
            jumps.append((energy_of(context) - previous, expected))
        start = energy_of(context)
        for _ in range(4):
            compound.step(round(0.005 / step))
            # Within a leg the energy stays, as far as steps of this size allow: an error of second order.
            assert abs(energy_of(context) - start) < 0.03 * (step / 0.0005) ** 2
            assert constraint_error(context.getSystem(), positions_of(context)) <= 1e-10 + 1e-13
        assert time_of(context) > time + 0.005
        time = time_of(context)
    assert context.getStepCount() == 8 * 4 * round(0.005 / step)
    assert ours.getNumForceEvaluations() >= 16 * round(0.005 / step)
    return jumps


@pytest.mark.parametrize("ours_first", [True, False])
def test_switching_back_and_forth(ours_first: bool, platform: str) -> None:
    """The energy is continuous but for the half step between VerletIntegrator's velocities and positions."""
    remainders = []
    for step in (0.0005, 0.00025):
        jumps = np.array(switching_jumps(step, ours_first, platform))
        print(f"step {step}: jumps {np.round(jumps[:, 0], 4)} expected {np.round(jumps[:, 1], 4)}")
        assert np.max(np.abs(jumps[:, 1])) > 0.01
        remainders.append(np.max(np.abs(jumps[:, 0] - jumps[:, 1])))
    # What half a step does not explain is of second order: a quarter in steps of half the size (with a margin, since
    # the switches come at other times).
    assert remainders[0] < 0.02
    assert remainders[1] < 0.5 * remainders[0]


def test_our_run_goes_on_from_what_verlet_left(platform: str) -> None:
    """After the other integrator nothing of the earlier leg is left but the reference value and rho's ratio to u."""
    model = chain()
    compound, ours, _, our_index, verlet_index = make_compound(0.0005, True)
    context = open_context(model.system(), compound, platform, model)
    compound.step(40)
    compound.setCurrentIntegrator(verlet_index)
    compound.step(40)
    assert value(compound.getStepSize()) == 0.0005
    compound.setCurrentIntegrator(our_index)
    fresh = make_integrator(setConstraintTolerance=1e-10)
    fresh.setReferenceMonitorValue(ours.getReferenceMonitorValue())
    other = open_context(model.system(), fresh, platform)
    other.setPositions(positions_of(context))
    other.setVelocities(velocities_of(context))
    here, start = positions_of(context), time_of(context)
    ours.stepTo(start + 0.02)
    fresh.stepTo(0.02)
    moved = np.max(np.abs(positions_of(context) - here))
    difference = np.max(np.abs(positions_of(context) - positions_of(other)))
    print(f"moved {moved:.1e}, difference {difference:.1e}")
    # The densities differ a little at the start, so these are two runs with errors of second order.
    assert moved > 0.01
    assert difference < 2e-3 * moved
    # With the state set by the user it is the very run of a new Context.
    context.setPositions(positions_of(other))
    context.setVelocities(velocities_of(other))
    other.setPositions(positions_of(other))
    other.setVelocities(velocities_of(other))
    assert_same_run(ours, context, fresh, other, atol=1e-9)


def test_only_the_other_integrator_moves() -> None:
    """Our member that waits costs nothing and does nothing to VerletIntegrator's trajectory."""
    model = chain()
    compound, ours, _, _, verlet_index = make_compound(0.0005, True)
    context = open_context(model.system(), compound, "Reference", model)
    compound.setCurrentIntegrator(verlet_index)
    compound.step(100)
    alone = openmm.VerletIntegrator(0.0005)
    alone.setConstraintTolerance(1e-10)
    other = open_context(model.system(), alone, "Reference", model)
    alone.step(100)
    assert np.array_equal(positions_of(context), positions_of(other))
    assert ours.getNumForceEvaluations() == 0
    assert ours.getReferenceMonitorValue() == 0


def test_members_by_index() -> None:
    """getIntegrator gives OpenMM's base class, whose methods are ours; two members of our kind do not mix."""
    model = chain()
    compound = openmm.CompoundIntegrator()
    members = [make_integrator(0.0005), make_integrator(0.0002)]
    for member in members:
        compound.addIntegrator(member)
    assert compound.getNumIntegrators() == 2
    context = open_context(model.system(), compound, "Reference", model)
    start = energy_of(context)
    for i in range(6):
        compound.setCurrentIntegrator(i % 2)
        member = compound.getIntegrator(i % 2)
        assert isinstance(member, openmm.Integrator)
        before = time_of(context)
        member.step(10)
        # Steps by the settings of its own; U changes by up to a factor of two along this run.
        assert 0.5 < (time_of(context) - before) / (10 * [0.0005, 0.0002][i % 2]) < 2
        assert value(member.getStepSize()) == value(members[i % 2].getStepSize())
        assert member.getConstraintTolerance() == 1e-8
    assert [member.getNumForceEvaluations() for member in members] == [33, 33]
    assert abs(energy_of(context) - start) < 0.05
    member = compound.getIntegrator(0)
    member.setStepSize(0.0001)
    assert value(members[0].getNominalStepSize()) == 0.0001


def test_force_groups_and_temperature_of_a_compound() -> None:
    model = chain()
    system = model.system()
    extra = openmm.CustomExternalForce("100*(x+0.3)^2")
    for i in range(8):
        extra.addParticle(i, [])
    extra.setForceGroup(3)
    system.addForce(extra)
    compound, ours, _, our_index, _ = make_compound(0.0005, True)
    compound.setIntegrationForceGroups(1)  # A bit mask, as this class has it.
    context = open_context(system, compound, "Reference", model)
    context.setVelocitiesToTemperature(300, 5)
    alone = make_integrator(setConstraintTolerance=1e-10)
    other = open_context(model.system(), alone, "Reference", model)
    other.setVelocities(velocities_of(context))
    compound.setCurrentIntegrator(our_index)
    compound.step(50)
    alone.step(50)
    assert np.array_equal(positions_of(context), positions_of(other))
    assert ours.getIntegrationForceGroups() == 1


def test_all_members_go_on_from_a_checkpoint(platform: str) -> None:
    """Those as well whose turn comes when others have moved the particles, with the density they had."""
    model = chain()
    langevin = VariableStepRattleLangevinIntegrator(300, 1, 0.001)
    langevin.setRandomNumberSeed(3)
    members = [make_integrator(0.001, "ConstraintAndAppliedForce"), make_integrator(0.0005), langevin]
    compound = openmm.CompoundIntegrator()
    for member in members:
        compound.addIntegrator(member)
    context = open_context(model.system(), compound, platform, model)

    def run(*turns: int) -> list[np.ndarray]:
        for turn in turns:
            compound.setCurrentIntegrator(turn)
            compound.step(5)
        densities = [member.getStepDensity() for member in members[:2]]
        return [positions_of(context), velocities_of(context), np.array(densities)]

    run(0, 1, 2)
    checkpoint = context.createCheckpoint()
    undisturbed = run(2, 1, 0)
    assert np.min(np.abs(undisturbed[2] - 1)) > 1e-4
    context.loadCheckpoint(checkpoint)
    for one, other in zip(undisturbed, run(2, 1, 0), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=0 if platform == "Reference" else 1e-5)


def test_steps_of_another_integrator_are_noticed_whatever_the_step_count(platform: str) -> None:
    """The user may set the step count back to what it was before the other integrator took its steps."""
    model = chain()
    compound = openmm.CompoundIntegrator()
    compound.addIntegrator(make_integrator())
    compound.addIntegrator(openmm.VerletIntegrator(0.0005))
    context = open_context(model.system(), compound, platform, model)
    compound.step(40)
    compound.setCurrentIntegrator(1)
    compound.step(40)
    context.setStepCount(40)
    compound.setCurrentIntegrator(0)
    before = positions_of(context)
    compound.step(1)
    # A step moves particles by about 1e-3 nm; from the positions before the other's steps it is fifty times as far.
    assert np.max(np.abs(positions_of(context) - before)) < 5e-3
