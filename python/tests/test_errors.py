# OpenMM-VRATTLE: what is wrong is said, and does no harm.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import openmm
import openmmvrattle
import pytest
from dense_reference import (
    UPDATES,
    chain,
    double_pendulum,
    open_context,
    positions_of,
    ring,
    time_of,
    value,
    velocities_of,
    waters,
)
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator

pytestmark = pytest.mark.filterwarnings("ignore:.etNormOrder:DeprecationWarning")

BAD_SIZES = [0.0, -0.001, float("nan"), float("inf"), -float("inf")]


@pytest.mark.parametrize("size", BAD_SIZES[1:])
def test_step_sizes_must_be_positive_and_finite(size: float) -> None:
    with pytest.raises(openmm.OpenMMException, match="step size"):
        VariableStepRattleIntegrator(size)
    integrator = VariableStepRattleIntegrator(0.001)
    for method in (integrator.setStepSize, integrator.setNominalStepSize):
        with pytest.raises(openmm.OpenMMException, match="step size"):
            method(size)
    for method in (integrator.setMinimumStepSize, integrator.setMaximumStepSize):
        with pytest.raises(openmm.OpenMMException, match="step size"):
            method(size)
    assert value(integrator.getNominalStepSize()) == 0.001
    assert value(integrator.getMaximumStepSize()) == 0.002
    assert value(integrator.getMinimumStepSize()) == 0.00002


@pytest.mark.parametrize("tolerance", BAD_SIZES)
def test_tolerance_must_be_positive_and_finite(tolerance: float) -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    with pytest.raises(openmm.OpenMMException, match="tolerance"):
        integrator.setConstraintTolerance(tolerance)
    assert integrator.getConstraintTolerance() == 1e-8


def test_bounds_must_enclose_the_nominal_size_when_a_step_is_taken() -> None:
    model = chain()
    integrator = VariableStepRattleIntegrator(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(2)
    time = time_of(context)
    for minimum, maximum in ((0.001, 0.002), (0.0011, 0.002), (0, 0.001), (0, 0.0009), (0.003, 0.0002)):
        integrator.setMinimumStepSize(minimum)
        integrator.setMaximumStepSize(maximum)
        for action in (lambda: integrator.step(1), lambda: integrator.stepTo(1.0), lambda: integrator.calibrate(2)):
            with pytest.raises(openmm.OpenMMException) as error:
                action()
            for size in (minimum, 0.001, maximum):
                assert f"({size:g} ps)" in str(error.value)
        # Neither a State nor a reference value is refused for it.
        context.getState(integratorParameters=True)
        assert integrator.getReferenceMonitorValue() > 0
    assert time_of(context) == time
    # In the order from which a setter would have to refuse one of the three.
    integrator.setMinimumStepSize(0.002)
    integrator.setMaximumStepSize(0.008)
    integrator.setStepSize(0.004)
    integrator.step(1)
    integrator.setMinimumStepSize(0)
    integrator.setMaximumStepSize(0)
    assert value(integrator.getMinimumStepSize()) == value(integrator.getMaximumStepSize()) == 0
    integrator.step(1)


def test_a_step_size_of_zero_is_for_energies() -> None:
    model = chain()
    integrator = VariableStepRattleIntegrator(0)
    context = open_context(model.system(), integrator, "Reference", model)
    assert value(context.getState(energy=True).getPotentialEnergy()) > 0
    assert len(integrator.getMultipliers()) == context.getSystem().getNumConstraints()
    integrator.step(0)
    for action in (
        lambda: integrator.step(1),
        lambda: integrator.stepTo(1.0),
        lambda: integrator.calibrate(2),
        integrator.reverse,
    ):
        with pytest.raises(openmm.OpenMMException, match="step size is 0.*setStepSize"):
            action()
    integrator.setStepSize(0.001)
    integrator.step(5)
    assert time_of(context) > 0


def test_the_step_size_that_was_set_is_returned_until_a_step_is_taken() -> None:
    model = chain()
    integrator = VariableStepRattleIntegrator(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(10)
    taken = value(integrator.getStepSize())
    assert taken != 0.001
    integrator.setStepSize(0.0007)
    assert value(integrator.getStepSize()) == 0.0007
    integrator.getMultipliers()
    assert value(integrator.getStepSize()) == 0.0007
    integrator.step(1)
    assert value(integrator.getStepSize()) == pytest.approx(0.7 * taken, rel=0.2)
    assert value(integrator.getStepSize()) != 0.0007
    assert context.getStepCount() == 11


def test_monitor_settings() -> None:
    kinds = VariableStepRattleIntegrator
    integrator = VariableStepRattleIntegrator(0.001)
    assert integrator.getNumMonitors() == 1
    assert tuple(integrator.getMonitor(0)) == (kinds.ConstraintMultipliers, 1.0, 1.0)
    for bad in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(openmm.OpenMMException, match="weight"):
            integrator.addMonitor(kinds.MaxForce, bad, 1.0)
        with pytest.raises(openmm.OpenMMException, match="power"):
            integrator.addMonitor(kinds.MaxForce, 1.0, bad)
    for kind in (-1, 11, 1000):
        with pytest.raises(openmm.OpenMMException, match="monitor"):
            integrator.addMonitor(kind)
    assert integrator.getNumMonitors() == 1
    for index in (-1, 1, 100):
        for call in (integrator.getMonitor, integrator.getReferenceMonitorValue, integrator.getMonitorValue):
            with pytest.raises(openmm.OpenMMException):
                call(index)
        with pytest.raises(openmm.OpenMMException, match="index|monitor"):
            integrator.setReferenceMonitorValue(1.0, index)
    for bad in (-1.0, float("nan"), float("inf")):
        with pytest.raises(openmm.OpenMMException, match="reference"):
            integrator.setReferenceMonitorValue(bad)
    for order in (0.0, 0.99, -8.0, float("nan"), float("inf")):
        with pytest.raises(openmm.OpenMMException, match="order"):
            integrator.setNormOrder(order)
    for group in (-1, 32):
        with pytest.raises(openmm.OpenMMException, match="group"):
            integrator.setMonitorForceGroup(group)
    for method in (-1, 3):
        with pytest.raises(openmm.OpenMMException, match="update"):
            integrator.setUpdateMethod(method)
    assert integrator.getNormOrder() == 8
    assert integrator.getMonitorForceGroup() == 31
    assert integrator.getUpdateMethod() == kinds.SemiExplicit
    assert integrator.getReferenceMonitorValue() == 0
    assert integrator.addMonitor(kinds.MaxForce, 0.5, 2.0) == 1
    assert tuple(integrator.getMonitor(1)) == (kinds.MaxForce, 0.5, 2.0)


def test_wrong_types_and_units() -> None:
    integrator = VariableStepRattleIntegrator(1 * unit.femtosecond)
    assert value(integrator.getStepSize()) == pytest.approx(0.001, rel=1e-15)
    langevin = openmmvrattle.VariableStepRattleLangevinIntegrator(300, 1, 0.002)
    calls: list[tuple[str, Callable[[], Any]]] = [
        ("size", lambda: integrator.setStepSize(1 * unit.nanometer)),
        ("size", lambda: integrator.setStepSize("0.001")),
        ("stepSize", lambda: VariableStepRattleIntegrator(None)),
        ("automatic", lambda: VariableStepRattleIntegrator(0.001, automatic=np.array([1, 2]))),
        ("frozen", lambda: langevin.freezeReference(np.array([1, 2]))),
        ("particles", lambda: integrator.addConstraint("x1", 1 * unit.nanometer)),
        ("expression", lambda: integrator.addConstraint(1, [0])),
        ("the name of a parameter", lambda: integrator.addConstraint("x1", [0], {1: 2})),
        ("the name of a parameter", lambda: integrator.setExpressionParameterValue(0, 0, 1)),
    ]
    for name, call in calls:
        with pytest.raises(TypeError, match=f"^{name} must be "):
            call()


def test_without_a_context() -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    calls: list[Callable[[], Any]] = [
        lambda: integrator.step(1),
        lambda: integrator.stepTo(1.0),
        integrator.reverse,
        integrator.getMultipliers,
        integrator.getMonitorValue,
        lambda: integrator.calibrate(5),
    ]
    for call in calls:
        with pytest.raises(openmm.OpenMMException, match="(?i)context"):
            call()
    assert integrator.getStepDensity() == 1
    assert integrator.getNumRescues() == 0


def test_before_positions_are_set(platform: str) -> None:
    model = chain()
    integrator = VariableStepRattleIntegrator(0.001)
    context = open_context(model.system(), integrator, platform)
    with pytest.raises(openmm.OpenMMException, match="(?i)position"):
        integrator.step(1)
    context.setPositions(model.positions)
    context.setVelocities(model.velocities)
    integrator.step(1)
    assert time_of(context) > 0


@pytest.mark.parametrize("target", [float("nan"), float("inf")])
def test_step_to_no_time(target: float) -> None:
    model = chain()
    integrator = VariableStepRattleIntegrator(0.001)
    context = open_context(model.system(), integrator, "Reference", model)
    with pytest.raises(openmm.OpenMMException, match="time"):
        integrator.stepTo(target)
    assert time_of(context) == 0


def test_collinear_distances_name_the_particles(platform: str) -> None:
    """All three distances of a linear molecule: three constraints of which only two are independent in first order."""
    system = openmm.System()
    for mass in (1.0, 20.0, 12.0, 16.0, 16.0):
        system.addParticle(mass)
    system.addConstraint(0, 1, 0.1)
    system.addConstraint(3, 2, 0.116)
    system.addConstraint(2, 4, 0.116)
    system.addConstraint(3, 4, 0.232)
    integrator = VariableStepRattleIntegrator(0.001)
    with pytest.raises(openmm.OpenMMException) as caught:
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
        context.setPositions([[0, 0, 0], [0.1, 0, 0], [1, 0, 0], [0.884, 0, 0], [1.116, 0, 0]])
        context.setVelocities(np.full((5, 3), 0.1))
        integrator.step(1)
    assert named_particles(str(caught.value)) == {2, 3, 4}, str(caught.value)
    assert "nan" not in str(caught.value).lower()


def test_redundant_framework(platform: str) -> None:
    """All ten distances of five particles in space: one more than they have degrees of freedom in their shape."""
    model = chain()
    system = openmm.System()
    for mass in model.masses:
        system.addParticle(float(mass))
    system.addConstraint(0, 1, float(model.lengths[0]))
    for i in range(3, 8):
        for j in range(i + 1, 8):
            system.addConstraint(i, j, float(np.linalg.norm(model.positions[i] - model.positions[j])))
    integrator = VariableStepRattleIntegrator(0.001)
    with pytest.raises(openmm.OpenMMException) as caught:
        context = open_context(system, integrator, platform, model)
        integrator.step(1)
        del context
    assert named_particles(str(caught.value)) == {3, 4, 5, 6, 7}, str(caught.value)


FLAT_MONITORS = [None, "ConstraintMultipliers", "ConstraintForce"]


@pytest.mark.parametrize("monitor", FLAT_MONITORS)
@pytest.mark.parametrize("missed_by", [0.0, 1e-5, 0.5])
def test_run_into_a_flat_rhombus(missed_by: float, monitor: str | None, platform: str) -> None:
    """Four equal rods, hinged into a ring of equal masses, fold together at a constant angular velocity.

    Folded flat, all rods lie on one line and one of the four constraints says what the others say: there the
    multipliers are not defined. A step of RATTLE turns the rods by exactly asin(h w), so the twentieth step ends at
    this angle times missed_by beside the flat configuration. If that is too close the step fails and names the
    particles; if not the run goes on through it. A shorter step after the failure goes on too.
    """
    step, turn, length = 0.001, 0.01, 1.0
    angle, speed = (20 + missed_by) * turn, length * np.sin(turn) / step
    axes = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
    along = np.array([np.cos(angle), np.sin(angle)] * 2)[:, None]
    across = np.array([np.sin(angle), -np.cos(angle)] * 2)[:, None]
    system = openmm.System()
    rods = [(0, 1), (1, 2), (2, 3), (3, 0)]
    for _ in range(4):
        system.addParticle(10)
    for rod in rods:
        system.addConstraint(*rod, length)
    integrator = VariableStepRattleIntegrator(step)
    integrator.clearMonitors()
    if monitor:
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, monitor))
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
    context.setPositions(length * along * axes)
    context.setVelocities(speed * across * axes)

    def rod_errors() -> list[float]:
        positions = positions_of(context)
        return [abs(np.linalg.norm(positions[i] - positions[j]) / length - 1) for i, j in rods]

    integrator.step(19)
    if missed_by < 1e-4:
        before = positions_of(context), velocities_of(context), time_of(context)
        with pytest.raises(openmm.OpenMMException, match="redundant or nearly so") as caught:
            integrator.step(1)
        assert named_particles(str(caught.value)) == {0, 1, 2, 3}, str(caught.value)
        assert np.array_equal(positions_of(context), before[0])
        assert np.array_equal(velocities_of(context), before[1])
        assert time_of(context) == before[2]
        integrator.setStepSize(0.7 * step)
    integrator.step(20)
    assert max(rod_errors()) <= 1e-8  # false for a NaN
    assert np.all(np.isfinite(velocities_of(context)))
    assert positions_of(context)[1][1] < 0, "through the flat configuration"


def named_particles(message: str) -> set[int]:
    """The numbers after the word particles in an error message."""
    found = re.search(r"particles((?:[ ,]|and|\d)+)", message)
    return {int(number) for number in re.findall(r"\d+", found.group(1))} if found else set()


def test_unknown_platform() -> None:
    """A platform without our kernel, where there is one."""
    names = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
    others = names - {name for served in openmmvrattle._PLATFORMS_OF_LIBRARY.values() for name in served}
    if not others:
        pytest.skip("this OpenMM has only platforms that are served")
    for name in others:
        model = chain()
        with pytest.raises(openmm.OpenMMException):
            open_context(model.system(), VariableStepRattleIntegrator(0.001), name, model)


@pytest.mark.parametrize("update", UPDATES)
def test_positions_that_are_no_numbers(update: str, platform: str) -> None:
    model = chain()
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    context = open_context(model.system(), integrator, platform, model)
    broken = model.positions.copy()
    broken[3, 1] = np.nan
    context.setPositions(broken)
    with pytest.raises(openmm.OpenMMException, match="(?i)nan|finite|not a number"):
        integrator.step(1)
    assert time_of(context) == 0
    context.setPositions(model.positions)
    integrator.step(5)
    assert np.all(np.isfinite(positions_of(context)))


@pytest.mark.parametrize("update", [*UPDATES, None])
@pytest.mark.parametrize("make", [chain, ring, waters])
def test_failed_step_leaves_the_state(make: Callable[[], Any], update: str | None, platform: str) -> None:
    """A step that is far too long fails; the Context is as before, and a shorter step goes on."""
    model = make()
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.setMinimumStepSize(0)
    integrator.setMaximumStepSize(0)
    if update is None:
        integrator.clearMonitors()
    else:
        integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(20)
    before = positions_of(context), velocities_of(context), time_of(context)
    density, reference = integrator.getStepDensity(), integrator.getReferenceMonitorValue() if update else 0
    integrator.setStepSize(50.0)
    with pytest.raises(openmm.OpenMMException) as caught:
        integrator.step(1)
    message = str(caught.value)
    assert "step" in message and "nan" not in message.lower()
    assert np.array_equal(positions_of(context), before[0])
    assert np.array_equal(velocities_of(context), before[1])
    assert time_of(context) == before[2]
    assert integrator.getStepDensity() == density
    if update:
        assert integrator.getReferenceMonitorValue() == reference
    integrator.setStepSize(0.0005)
    integrator.step(50)
    c = model.constraints()
    assert np.max(np.abs(c.relative_errors(positions_of(context).ravel()))) <= 1e-8 + 1e-14
    assert time_of(context) > before[2] + 0.001
    # It is the motion that would have been without the failure.
    other = VariableStepRattleIntegrator(0.001)
    other.setMinimumStepSize(0)
    other.setMaximumStepSize(0)
    if update is None:
        other.clearMonitors()
    else:
        other.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    undisturbed = open_context(model.system(), other, platform, model)
    other.step(20)
    other.setStepSize(0.0005)
    other.step(50)
    np.testing.assert_allclose(positions_of(context), positions_of(undisturbed), rtol=0, atol=1e-7)


def test_failed_first_step(platform: str) -> None:
    model = chain()
    integrator = VariableStepRattleIntegrator(50.0)
    context = open_context(model.system(), integrator, platform, model)
    with pytest.raises(openmm.OpenMMException):
        integrator.step(1)
    assert time_of(context) == 0
    assert np.array_equal(positions_of(context), model.positions)
    assert np.array_equal(velocities_of(context), model.velocities)
    assert integrator.getReferenceMonitorValue() == 0
    integrator.setStepSize(0.0005)
    integrator.step(10)
    assert 0.001 < time_of(context) < 0.02


@pytest.mark.parametrize("failure", ["raises", "nan"])
@pytest.mark.parametrize("update", UPDATES)
def test_failing_force(update: str, failure: str, platform: str) -> None:
    """The force is computed at the new positions, when the step is half done: that must be undone."""
    model = chain()
    broken = False

    def force(state: openmm.State) -> tuple[float, np.ndarray]:
        if broken and failure == "raises":
            raise RuntimeError("out of order")
        q = state.getPositions(asNumpy=True)._value
        return float(np.sum(50 * q**2)), np.where(broken, np.nan, -100 * q)

    system = model.system()
    system.addForce(openmm.PythonForce(force))
    runs = []
    for fail in (False, True):
        broken = False
        integrator = VariableStepRattleIntegrator(0.0005)
        integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
        context = open_context(system, integrator, platform, model)
        integrator.step(20)
        if fail:
            broken = True
            before = positions_of(context), velocities_of(context), time_of(context), integrator.getStepDensity()
            for _ in range(2):
                with pytest.raises(Exception, match="out of order" if failure == "raises" else "(?i)force|nan|finite"):
                    integrator.step(3)
            assert np.array_equal(positions_of(context), before[0])
            assert np.array_equal(velocities_of(context), before[1])
            assert time_of(context) == before[2]
            assert integrator.getStepDensity() == before[3]
            broken = False
        integrator.step(20)
        runs.append((positions_of(context), velocities_of(context), time_of(context)))
        del context
    # To the last bit on Reference; the CPU platform computes the same here.
    for undisturbed, disturbed in zip(*runs, strict=True):
        assert np.array_equal(undisturbed, disturbed)


@pytest.mark.parametrize("control", ["monitor", "automatic", "fixed"])
def test_a_force_that_is_no_number_names_its_particle(control: str, platform: str) -> None:
    model = chain()
    system = model.system()
    force = openmm.CustomExternalForce("k*select(step(limit-x), x, sqrt(limit-x))")
    force.addGlobalParameter("k", 1.0)
    force.addGlobalParameter("limit", 10.0)
    for i in (5, 3):
        force.addParticle(i)
    system.addForce(force)
    integrator = VariableStepRattleIntegrator(0.0005, automatic=control == "automatic")
    if control == "fixed":
        integrator.clearMonitors()
    context = open_context(system, integrator, platform, model)
    for name, bad, words in [("limit", -10.0, "is infinite or not a number"), ("k", 1e200, "is too large to compute")]:
        for steps in (0, 2):  # at the start, and in the course of a run
            context.setPositions(model.positions)
            integrator.step(steps)
            good = context.getParameter(name)
            context.setParameter(name, bad)
            with pytest.raises(
                openmm.OpenMMException, match=f"because the force on particle [35] {words}.*; set other"
            ):
                integrator.step(1)
            context.setParameter(name, good)
            integrator.step(1)


def test_failed_step_says_when_and_what_to_change(platform: str) -> None:
    model = double_pendulum()
    integrator = VariableStepRattleIntegrator(0.01)
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(3)
    integrator.setStepSize(1000.0)
    with pytest.raises(openmm.OpenMMException, match=r"(?i)time|at t") as caught:
        integrator.step(1)
    # The time to at least three figures, and what can be changed.
    assert f"{time_of(context):.3g}"[:4] in str(caught.value), str(caught.value)
    assert "smaller" in str(caught.value) or "reduce" in str(caught.value).lower(), str(caught.value)


def test_no_constraints_for_a_constraint_monitor(platform: str) -> None:
    """The default monitor has nothing to look at in a system without constraints: say so, and name others."""
    system = openmm.System()
    system.addParticle(1.0)
    system.addParticle(1.0)
    bond = openmm.HarmonicBondForce()
    bond.addBond(0, 1, 0.1, 1000.0)
    system.addForce(bond)
    for kind in ("ConstraintMultipliers", "ConstraintForce", "MultiplierPNorm"):
        integrator = VariableStepRattleIntegrator(0.001)
        integrator.clearMonitors()
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, kind))
        with pytest.raises(openmm.OpenMMException, match="AppliedForce|ForcePNorm|VectorField|MaxForce") as caught:
            context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
            context.setPositions([[0, 0, 0], [0.12, 0, 0]])
            integrator.step(1)
        assert "constraint" in str(caught.value).lower()
    for kind in ("AppliedForce", "VectorField", "ForcePNorm", "MaxForce", "ArcLength"):
        integrator = VariableStepRattleIntegrator(0.001)
        integrator.clearMonitors()
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, kind))
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
        context.setPositions([[0, 0, 0], [0.12, 0, 0]])
        context.setVelocities([[0, 0.1, 0], [0, -0.1, 0]])
        integrator.step(20)
        assert len(integrator.getMultipliers()) == 0
        del context


def test_start_where_the_monitor_vanishes(platform: str) -> None:
    """No force and no motion: U = 0 asks for nothing and is no reference, and nothing is divided by it."""
    model = ring()
    model.add_forces = lambda system: None
    model.velocities = np.zeros((6, 3))
    integrator = VariableStepRattleIntegrator(0.001)
    context = open_context(model.system(), integrator, platform, model)
    for reference in (0.0, 1.0):
        integrator.setReferenceMonitorValue(reference)
        for _ in range(5):
            integrator.step(1)
            assert value(integrator.getStepSize()) == 0.001
        assert integrator.getReferenceMonitorValue() == reference
    np.testing.assert_allclose(positions_of(context), model.positions, rtol=0, atol=1e-12)


def test_energy_monitor_must_be_positive(platform: str) -> None:
    model = chain()
    system = model.system()
    force = openmm.CustomBondForce("-1")
    force.addBond(0, 7, [])
    force.setForceGroup(31)
    system.addForce(force)
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.clearMonitors()
    integrator.addMonitor(VariableStepRattleIntegrator.ForceGroupEnergy)
    context = open_context(system, integrator, platform, model)
    with pytest.raises(openmm.OpenMMException, match="(?i)positive|negative"):
        integrator.step(1)
    assert time_of(context) == 0


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_energy_monitor_that_becomes_negative(power: float) -> None:
    """It starts positive and is negative some steps later: no measure of anything, and that is to be said."""
    model = chain()
    system = model.system()
    start = np.linalg.norm(model.positions[7] - model.positions[0])
    force = openmm.CustomBondForce(f"r-{start - 0.003}")
    force.addBond(0, 7, [])
    force.setForceGroup(31)
    system.addForce(force)
    integrator = VariableStepRattleIntegrator(0.0005)
    integrator.clearMonitors()
    integrator.addMonitor(VariableStepRattleIntegrator.ForceGroupEnergy, 1.0, power)
    context = open_context(system, integrator, "Reference", model)
    with pytest.raises(openmm.OpenMMException, match="(?i)monitor.*(positive|negative)"):
        integrator.step(20)
    assert np.all(np.isfinite(positions_of(context)))
