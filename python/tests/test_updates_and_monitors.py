# OpenMM-VRATTLE: every update with every monitor: reversible, as written down, and in collisions that are too hard.
# SPDX-License-Identifier: MIT

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import (
    EXPLICIT,
    KINDS,
    SEMI_EXPLICIT,
    UPDATES,
    Control,
    Model,
    chain,
    energy_of,
    open_context,
    positions_of,
    time_of,
    value,
    velocities_of,
    waters,
)
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator
from recorded_run import check_equations, record
from run_support import rattle_as_custom_integrator

pytestmark = pytest.mark.filterwarnings("ignore:.etNormOrder:DeprecationWarning")


def chain_with_energy_monitor() -> tuple[Model, openmm.System]:
    """The chain, and in group 31 a positive function of its end-to-end distance for ForceGroupEnergy."""
    model = chain()
    system = model.system()
    force = openmm.CustomBondForce("(0.4/r)^3")
    force.addBond(0, 7, [])
    force.setForceGroup(31)
    system.addForce(force)
    return model, system


def integrator_with(
    update: str, step: float, monitors: list[tuple[str, float, float]], tolerance: float = 1e-12
) -> VariableStepRattleIntegrator:
    integrator = VariableStepRattleIntegrator(step)
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    integrator.setConstraintTolerance(tolerance)
    integrator.clearMonitors()
    for kind, weight, power in monitors:
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, kind), weight, power)
    return integrator


# ------------------------------------------------------------------------------------------------- every monitor


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("update", UPDATES)
def test_reversible_with_every_monitor(update: str, kind: str) -> None:
    """There and back in twice 200 steps, also with a power and without bounds: the start is met to the tolerance."""
    for monitors, bounded in (([(kind, 1.0, 1.0)], True), ([(kind, 2.0, 0.5), ("VectorField", 1.0, 1.0)], False)):
        model, system = chain_with_energy_monitor()
        integrator = integrator_with(update, 0.0005, monitors)
        if not bounded:
            integrator.setMinimumStepSize(0)
            integrator.setMaximumStepSize(0)
        context = open_context(system, integrator, "Reference", model)
        sizes = []
        for _ in range(200):
            integrator.step(1)
            sizes.append(value(integrator.getStepSize()))
        assert max(sizes) > 1.01 * min(sizes)
        assert np.max(np.abs(positions_of(context) - model.positions)) > 0.02
        integrator.reverse()
        integrator.step(200)
        assert integrator.getNumRescues() == 0
        # 1e-12 of the constraints and of the density's equation, and the growth of that along 400 steps.
        np.testing.assert_allclose(positions_of(context), model.positions, rtol=0, atol=1e-9)
        np.testing.assert_allclose(velocities_of(context), -model.velocities, rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_every_monitor_with_weight_and_power(kind: str) -> None:
    """In a combination each monitor counts relative to its reference value, with its weight and its power."""
    for power in (0.5, 2.0):
        model, system = chain_with_energy_monitor()
        other = "AppliedForce" if kind != "AppliedForce" else "MaxForce"
        control = Control(0.0005, monitors=[(kind, 1.5, power), (other, 0.4, 1.0)])
        run = record(model, system, control, "Reference", 1e-12, 60)
        check_equations(run, model.constraints(), control, 1e-12, 1e-9)


@pytest.mark.parametrize("update", UPDATES)
def test_weight_of_a_single_monitor(update: str) -> None:
    """It is normalised away; and a monitor that is given twice is the same as given once."""
    model = chain()
    ends = []
    for monitors in (
        [("ConstraintForce", 1.0, 1.0)],
        [("ConstraintForce", 7.0, 1.0)],
        [("ConstraintForce", 7.0, 1.0), ("ConstraintForce", 0.2, 1.0)],
    ):
        integrator = integrator_with(update, 0.0005, monitors)
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.step(100)
        ends.append((time_of(context), positions_of(context)))
    for time, positions in ends[1:]:
        assert time == pytest.approx(ends[0][0], rel=1e-10)
        np.testing.assert_allclose(positions, ends[0][1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["ForcePNorm", "MaxForce"])
@pytest.mark.parametrize("update", UPDATES)
def test_setting_what_is_set_already_changes_nothing(update: str, kind: str) -> None:
    """Not the norms of forces either, which are found once for each state."""
    model = chain()
    runs = []
    for is_set_again in (False, True):
        integrator = integrator_with(update, 0.001, [(kind, 1.0, 0.5), ("ConstraintForce", 1.0, 1.0)])
        context = open_context(model.system(), integrator, "Reference", model)
        sizes = []
        for _ in range(20):
            if is_set_again:
                integrator.setConstraintTolerance(1e-12)
            integrator.step(1)
            sizes.append(value(integrator.getStepSize()))
        integrator.reverse()
        integrator.step(1)
        runs.append((sizes, positions_of(context)))
    assert runs[0][0] == runs[1][0]
    assert np.array_equal(runs[0][1], runs[1][1])


@pytest.mark.parametrize("update", UPDATES)
def test_a_monitor_of_forces_does_not_see_a_constraint_that_begins_to_move(update: str) -> None:
    sizes = []
    for distance in (0.3, 0.303):
        system = openmm.System()
        integrator = integrator_with(update, 0.001, [("ForcePNorm", 1.0, 1.0)])
        integrator.addConstraint("x2 - x1 - distance", [0, 1], {"distance": 0.3})
        field = openmm.CustomExternalForce("-8*y")
        for particle in range(2):
            system.addParticle(12.0)
            field.addParticle(particle)
        system.addForce(field)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions([[0.0, 0, 0], [0.3, 0, 0]])
        integrator.step(5)
        integrator.setExpressionParameterValue(0, "distance", distance)
        integrator.step(1)
        sizes.append(value(integrator.getStepSize()))
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-9)


def test_unit_of_a_monitor_does_not_matter() -> None:
    """Normalised term by term: the energy of a group in other units gives the same steps, its weight being the same."""
    ends = []
    for factor in (1.0, 1000.0):
        model = chain()
        system = model.system()
        force = openmm.CustomBondForce(f"{factor}*(0.4/r)^3")
        force.addBond(0, 7, [])
        force.setForceGroup(31)
        system.addForce(force)
        integrator = integrator_with(
            SEMI_EXPLICIT, 0.0005, [("ForceGroupEnergy", 1.0, 1.0), ("ConstraintForce", 1.0, 1.0)]
        )
        context = open_context(system, integrator, "Reference", model)
        integrator.step(100)
        ends.append((time_of(context), value(integrator.getReferenceMonitorValue(0))))
    assert ends[1][0] == pytest.approx(ends[0][0], rel=1e-11)
    assert ends[1][1] == pytest.approx(1000 * ends[0][1], rel=1e-11)


# -------------------------------------------------------------------------------------------------- hard collisions


@dataclass
class Collisions:
    """What was seen in all of a set of collisions."""

    rescues: int = 0
    failures: int = 0
    survived_rescue: int = 0
    """Runs with a rescue that nevertheless reached their end."""
    steps: int = 0
    largest_step: float = 0.0
    smallest_density: float = np.inf
    largest_density: float = 0.0
    largest_error: float = 0.0
    """Of the energy, relative."""


@dataclass(frozen=True)
class Impact:
    """A way to shoot, with steps so coarse that sum updates fall below zero."""

    kind: str
    power: float
    reference: float
    speed: float
    """nm/ps, or km/s"""
    step: float
    """ps"""


IMPACTS = (
    Impact("ForcePNorm", 1.0, 1000.0, 20.0, 0.003),
    Impact("ForcePNorm", 2.0, 3000.0, 20.0, 0.0015),
    Impact("ConstraintMultipliers", 2.0, 3000.0, 10.0, 0.003),
)
BOND = 0.11


def diatomics() -> openmm.System:
    """Two rigid diatomics of the mass of nitrogen, with Lennard-Jones forces between them."""
    system = openmm.System()
    for _ in range(4):
        system.addParticle(14.007)
    for first in (0, 2):
        system.addConstraint(first, first + 1, BOND)
    force = openmm.CustomBondForce("4*0.3*((0.33/r)^12-(0.33/r)^6)")
    for i in (0, 1):
        for j in (2, 3):
            force.addBond(i, j, [])
    system.addForce(force)
    return system


def shoot(update: str, impact: Impact, offset: float) -> tuple[VariableStepRattleIntegrator, openmm.Context]:
    """One diatomic flies at the other from 1.2 nm away, the other one's centre being so much off the line."""
    centres = np.array([[-0.6, 0.0, 0.0], [0.6, offset, 0.0]])
    positions, velocities = np.empty((4, 3)), np.empty((4, 3))
    for molecule, axis in enumerate(([0.5, 0.8, 0.1], [0.3, 0.5, 0.8])):
        for atom, sign in ((2 * molecule, -1), (2 * molecule + 1, 1)):
            arm = sign * BOND / 2 * np.array(axis) / np.linalg.norm(axis)
            positions[atom] = centres[molecule] + arm
            velocities[atom] = [impact.speed / 2 * (1 - 2 * molecule), 0, 0] + np.cross([1.0, 2.0, -1.0], arm)
    integrator = integrator_with(update, impact.step, [(impact.kind, 1.0, impact.power)], 1e-8)
    integrator.setReferenceMonitorValue(impact.reference)
    context = open_context(diatomics(), integrator, "Reference")
    context.setPositions(positions)
    context.setVelocities(velocities)
    return integrator, context


def collide(update: str, impact: Impact, count: int = 24) -> Collisions:
    """Shoot by and by further off the centre, and look at every step."""
    result = Collisions()
    for run in range(count):
        integrator, context = shoot(update, impact, 0.12 * run / count - 0.02)
        start = energy_of(context)
        rescues = 0
        try:
            while time_of(context) < 2 / impact.speed:
                integrator.step(1)
                size, density = value(integrator.getStepSize()), integrator.getStepDensity()
                assert 0 < size < np.inf and size == pytest.approx(impact.step / density, rel=1e-12)
                if integrator.getNumRescues() > rescues:
                    # The step is as good as any in all but its size.
                    rescues = integrator.getNumRescues()
                    q = positions_of(context)
                    for first in (0, 2):
                        assert np.linalg.norm(q[first] - q[first + 1]) == pytest.approx(BOND, rel=2e-8)
                result.steps += 1
                result.largest_step = max(result.largest_step, size)
                result.smallest_density = min(result.smallest_density, density)
                result.largest_density = max(result.largest_density, density)
                result.largest_error = max(result.largest_error, abs(energy_of(context) / start - 1))
            result.survived_rescue += rescues > 0
        except openmm.OpenMMException:
            result.failures += 1
        result.rescues += rescues
    print(update, impact, result)
    return result


@pytest.mark.parametrize("impact", IMPACTS, ids=lambda impact: f"{impact.kind}^{impact.power:g}")
def test_bounded_update_in_hard_collisions(impact: Impact) -> None:
    """Where sum updates need rescues Bounded needs none: every step strictly below the maximum, none of no size."""
    bounded = collide("Bounded", impact)
    assert bounded.rescues == 0 and bounded.failures == 0
    # The maximum is at its default, twice the nominal step, so the density stays above a = 1/2. Measured 0.83 of it.
    assert bounded.largest_step < 2 * impact.step
    assert bounded.smallest_density > 0.5
    # They did collide, and it was followed: the energy is kept to 2 to 7 % in a collision of a few steps.
    assert bounded.largest_density > 5
    assert bounded.largest_error < 0.2


@pytest.mark.parametrize("update", [SEMI_EXPLICIT, EXPLICIT])
@pytest.mark.parametrize("impact", IMPACTS, ids=lambda impact: f"{impact.kind}^{impact.power:g}")
def test_sum_updates_in_hard_collisions(impact: Impact, update: str) -> None:
    """The same collisions: steps are rescued, the run goes on with a positive density, and the rescue is counted."""
    sums = collide(update, impact)
    # Measured 5 to 34 in 24 collisions.
    assert sums.rescues > 0
    assert sums.survived_rescue > 0
    assert sums.smallest_density > 0
    # And the maximum is no strict bound: measured 2.5 to 7 times above it.
    assert sums.largest_step > 2 * impact.step


# -------------------------------------------------------------------------------------------------------- defaults


def test_defaults_of_all_settings() -> None:
    integrator = VariableStepRattleIntegrator(0.002)
    assert value(integrator.getNominalStepSize()) == value(integrator.getStepSize()) == 0.002
    assert value(integrator.getMinimumStepSize()) == pytest.approx(0.002 / 50, rel=1e-15)
    assert value(integrator.getMaximumStepSize()) == pytest.approx(2 * 0.002, rel=1e-15)
    assert integrator.getUpdateMethod() == VariableStepRattleIntegrator.SemiExplicit
    assert integrator.getNumMonitors() == 1
    assert tuple(integrator.getMonitor(0)) == (VariableStepRattleIntegrator.ConstraintMultipliers, 1.0, 1.0)
    assert integrator.getReferenceMonitorValue() == 0
    assert integrator.getNormOrder() == 8
    assert integrator.getConstraintTolerance() == 1e-8
    assert integrator.getStepDensity() == 1
    # The bounds that were not set follow the nominal step; those that were set stay.
    integrator.setMaximumStepSize(0.007 * unit.picoseconds)
    integrator.setNominalStepSize(0.005)
    assert value(integrator.getMinimumStepSize()) == pytest.approx(0.005 / 50, rel=1e-15)
    assert value(integrator.getMaximumStepSize()) == pytest.approx(0.007, rel=1e-15)
    integrator.setMinimumStepSize(0)
    assert value(integrator.getMinimumStepSize()) == 0


# ------------------------------------------------------------------------------------------------------- calibrate


def with_thermostat() -> tuple[openmm.System, Model]:
    model = waters()
    system = model.system()
    thermostat = openmm.AndersenThermostat(300, 50)
    thermostat.setRandomNumberSeed(8)
    system.addForce(thermostat)
    return system, model


def with_barostat() -> tuple[openmm.System, Model]:
    model = waters()
    system = model.system()
    system.setDefaultPeriodicBoxVectors([1.6, 0, 0], [0, 1.6, 0], [0, 0, 1.6])
    force = system.getForce(0)
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.6)
    # Every third step, at a pressure that makes most moves count.
    barostat = openmm.MonteCarloBarostat(1000, 300, 3)
    barostat.setRandomNumberSeed(4)
    system.addForce(barostat)
    return system, model


def with_virtual_sites() -> tuple[openmm.System, Model]:
    """A charge on the middle of the first bond of each water, which moves with it."""
    model = waters()
    system = model.system()
    force = system.getForce(0)
    for first in range(0, 24, 3):
        site = system.addParticle(0.0)
        system.setVirtualSite(site, openmm.TwoParticleAverageSite(first, first + 1, 0.5, 0.5))
        force.addParticle(0.05, 1.0, 0.0)
        for i in range(3):
            force.addException(first + i, site, 0.0, 1.0, 0.0)
    positions = np.concatenate([model.positions, (model.positions[0::3] + model.positions[1::3]) / 2])
    return system, Model(
        "sites", *(getattr(model, name) for name in ("masses", "pairs", "lengths")), positions,
        np.concatenate([model.velocities, np.zeros((8, 3))]), model.step, model.add_forces,
    )  # fmt: skip


def whole_state(context: Any) -> dict[str, Any]:
    """All that can be seen of a Context, as arrays and numbers."""
    state = context.getState(positions=True, velocities=True, forces=True, energy=True)
    return {
        "positions": state.getPositions(asNumpy=True)._value,
        "velocities": state.getVelocities(asNumpy=True)._value,
        "forces": state.getForces(asNumpy=True)._value,
        "energies": [state.getPotentialEnergy()._value, state.getKineticEnergy()._value],
        "time": state.getTime()._value,
        "step count": state.getStepCount(),
        "box": state.getPeriodicBoxVectors(asNumpy=True)._value,
    }


def assert_same(first: dict[str, Any], second: dict[str, Any]) -> None:
    """To the last bit."""
    for name, content in first.items():
        assert np.array_equal(content, second[name]), name


@pytest.mark.parametrize("steps_before", [0, 25])
@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("make", [with_thermostat, with_barostat, with_virtual_sites])
def test_calibrate_leaves_everything_as_it_was(
    make: Callable[[], tuple[openmm.System, Model]], update: str, steps_before: int
) -> None:
    """State, forces and random streams: the run goes on as one in which the same reference value was set instead."""
    system, model = make()
    monitors = [("ConstraintAndAppliedForce", 1.0, 1.0), ("ForcePNorm", 1.0, 0.5)]

    def start() -> tuple[VariableStepRattleIntegrator, openmm.Context]:
        integrator = integrator_with(update, 0.0005, monitors, 1e-10)
        context = open_context(system, integrator, "Reference", model)
        integrator.step(steps_before)
        return integrator, context

    def go_on(integrator: VariableStepRattleIntegrator, context: openmm.Context) -> list[dict[str, Any]]:
        states = []
        for _ in range(4):
            integrator.step(15)
            states.append(whole_state(context))
        return states

    # One run after the other: the platform Reference has one stream of random numbers, which each Context starts again.
    integrator, context = start()
    size, density, before = value(integrator.getStepSize()), integrator.getStepDensity(), whole_state(context)
    old = [value(integrator.getReferenceMonitorValue(k)) for k in range(2)]
    integrator.calibrate(30)
    references = [value(integrator.getReferenceMonitorValue(k)) for k in range(2)]
    assert all(new > 0 and new != was for new, was in zip(references, old, strict=True))
    assert_same(before, whole_state(context))
    assert before["step count"] == steps_before
    assert value(integrator.getStepSize()) == size and integrator.getStepDensity() == density
    calibrated = go_on(integrator, context)

    integrator, context = start()
    assert_same(before, whole_state(context))
    for k in range(2):
        integrator.setReferenceMonitorValue(references[k], k)
    for expected, found in zip(go_on(integrator, context), calibrated, strict=True):
        assert_same(expected, found)
    if make is with_barostat:
        assert not np.array_equal(before["box"], calibrated[-1]["box"])


def test_calibrate_that_fails_leaves_everything_as_it_was(platform: str) -> None:
    """The third trial step meets a force that is not a number."""
    model = chain()
    calls = 0

    def force(state: openmm.State) -> tuple[float, Any]:
        nonlocal calls
        calls += 1
        return 0.0, np.full((8, 3), np.nan if calls > 3 else 0.0)

    system = model.system()
    system.addForce(openmm.PythonForce(force))
    integrator = VariableStepRattleIntegrator(0.0005)
    context = open_context(system, integrator, platform, model)
    with pytest.raises(openmm.OpenMMException, match="(?i)force"):
        integrator.calibrate(10)
    assert integrator.getReferenceMonitorValue() == 0
    assert np.array_equal(positions_of(context), model.positions)
    assert np.array_equal(velocities_of(context), model.velocities)
    assert time_of(context) == 0 and context.getStepCount() == 0


# ---------------------------------------------------------------------------------------------------- plain RATTLE


def test_plain_rattle_is_velocity_verlet_to_1e_9() -> None:
    """Rigid waters, which OpenMM's SETTLE solves exactly: positions and velocities, after every step."""
    model = waters()
    ours = VariableStepRattleIntegrator(0.001)
    ours.clearMonitors()
    ours.setConstraintTolerance(1e-13)
    theirs = rattle_as_custom_integrator(0.001)
    context = open_context(model.system(), ours, "Reference", model)
    other = open_context(model.system(), theirs, "Reference", model)
    largest = 0.0
    for _ in range(200):
        ours.step(1)
        theirs.step(1)
        for read in (positions_of, velocities_of):
            largest = max(largest, float(np.max(np.abs(read(context) - read(other)))))
            assert largest < 1e-9
    print(f"largest difference {largest:.1e}")
    assert np.max(np.abs(positions_of(context) - model.positions)) > 0.05
