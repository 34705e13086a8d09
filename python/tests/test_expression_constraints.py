# OpenMM-VRATTLE: constraints given as expressions, from the outside: how they are set, saved, changed and refused.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import (
    UPDATES,
    Array,
    energy_of,
    general,
    open_context,
    positions_of,
    time_of,
    value,
    velocities_of,
)
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator, XmlSerializer

SPHERE = "sqrt(x1^2+y1^2+z1^2) - r"


def make_integrator(step: float = 0.001, update: str = "SemiExplicit", monitor: str = "ConstraintForce") -> Any:
    integrator = VariableStepRattleIntegrator(step, monitors=[getattr(VariableStepRattleIntegrator, monitor)])
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    integrator.setConstraintTolerance(1e-12)
    return integrator


def particles(*masses: float, force: str = "") -> openmm.System:
    system = openmm.System()
    for mass in masses:
        system.addParticle(mass)
    if force:
        external = openmm.CustomExternalForce(force)
        for i in range(len(masses)):
            external.addParticle(i, [])
        system.addForce(external)
    return system


def on_sphere(radius: float = 1.0, monitor: str = "ConstraintForce", platform: str = "Reference") -> tuple[Any, Any]:
    """A particle on a sphere about the origin under gravity; the integrator and its Context."""
    integrator = make_integrator(0.01, monitor=monitor)
    integrator.addConstraint(SPHERE, [0], {"r": radius})
    context = open_context(particles(2.0, force="20*z"), integrator, platform)
    context.setPositions([[0.6, 0, 0.8]])
    context.setVelocities([[0, 1, 0]])
    return integrator, context


def state_of(context: Any) -> Array:
    return np.concatenate([positions_of(context).ravel(), velocities_of(context).ravel()])


# ---------------------------------------------------------------------------------------------------- set and read


def test_what_was_added_can_be_read() -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    assert integrator.getNumExpressionConstraints() == 0
    first = integrator.addConstraint("x1-x2-d", np.array([3, 1]), {"d": 0.2 * unit.angstrom})
    second = integrator.addConstraint("k*x1^2*y1-angle", (4,), {"angle": 180 * unit.degree, "k": 2})
    third = integrator.addConstraint("z1", range(5, 6))
    assert (first, second, third) == (0, 1, 2)
    assert integrator.getNumExpressionConstraints() == 3
    assert integrator.getExpressionConstraintParameters(0) == ("x1-x2-d", [3, 1], {"d": pytest.approx(0.02)})
    assert integrator.getExpressionConstraintParameters(1)[2] == {"angle": pytest.approx(np.pi), "k": 2.0}
    assert integrator.getExpressionConstraintParameters(np.int64(2)) == ("z1", [5], {})
    integrator.setExpressionParameterValue(0, "d", 1 * unit.nanometer)
    assert integrator.getExpressionConstraintParameters(0)[2] == {"d": 1.0}
    integrator.setExpressionConstraintParameters(2, "z1+k", [6], parameters={"k": 3})
    assert integrator.getExpressionConstraintParameters(2) == ("z1+k", [6], {"k": 3.0})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("x1+", [0]), "cannot be understood"),
        (("", [0]), "cannot be understood"),
        (("x1+(y1", [0]), "cannot be understood"),
        (("x1-distance(1,2)", [0]), "cannot be understood"),
        (("x1-r0", [0]), "contains the variable r0, which is neither a coordinate"),
        (("x1-R0", [0], {"r0": 1}), "contains the variable R0"),
        (("x1-t; s = 2", [0], {}), "contains the variable t"),
        (("x0", [0]), "contains the variable x0"),
        (("x1-x3", [0, 1]), "contains x3 and is of 2 particles alone"),
        (("x1-x2", [7]), "contains x2 and is of 1 particle alone"),
        (("x1", []), "contains x1 and is of 0 particles"),
        (("k", [0], {"k": 1}), "contains no coordinate"),
        (("x1-x2", [4, 4]), "names particle 4 twice"),
        (("x1-x2", [4, -1]), "is of particle -1"),
        (("x1-y1", [0], {"y1": 2}), "has a parameter y1, which is the name of a coordinate"),
        (("x1-k", [0], {"k": float("nan")}), "has the parameter k, whose value is not a finite number"),
    ],
)
def test_what_cannot_be_added(arguments: Any, message: str) -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    with pytest.raises(openmm.OpenMMException, match=message):
        integrator.addConstraint(*arguments)
    assert integrator.getNumExpressionConstraints() == 0
    integrator.addConstraint("x1-k", [0], {"k": 1})
    with pytest.raises(openmm.OpenMMException, match=message):
        integrator.setExpressionConstraintParameters(0, *arguments)
    assert integrator.getExpressionConstraintParameters(0) == ("x1-k", [0], {"k": 1.0})


@pytest.mark.parametrize(
    "arguments",
    [
        (3, [0]),
        ("x1", "0"),
        ("x1", 0),
        ("x1", [0.5]),
        ("x1-k", [0], {"k": "1"}),
        ("x1-k", [0], [1]),
        ("x1", [0], {1: 1}),
    ],
)
def test_arguments_of_a_wrong_type(arguments: Any) -> None:
    with pytest.raises(TypeError):
        VariableStepRattleIntegrator(0.001).addConstraint(*arguments)


def test_indices_and_names_that_are_not_there() -> None:
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.addConstraint("x1-k", [0], {"k": 1})
    for index in (-1, 1):
        for call in (
            lambda i=index: integrator.getExpressionConstraintParameters(i),
            lambda i=index: integrator.setExpressionConstraintParameters(i, "x1", [0]),
            lambda i=index: integrator.setExpressionParameterValue(i, "k", 1),
        ):
            with pytest.raises(openmm.OpenMMException, match=f"no expression constraint with index {index}"):
                call()
    with pytest.raises(openmm.OpenMMException, match="has no parameter q"):
        integrator.setExpressionParameterValue(0, "q", 1)
    with pytest.raises(openmm.OpenMMException, match="not bound to a context"):
        integrator.getExpressionConstraintMultiplier(0)


@pytest.mark.parametrize(
    ("masses", "expression", "indices", "message"),
    [
        ((1, 1), "x1-x2", [0, 2], "expression constraint 0 .x1-x2. is of particle 2, and the System has 2"),
        ((0, 1), "x1-1", [0], "has no particle with mass"),
        ((1, 1, 0), "x1-x2", [0, 2], "is of particle 2, which is a virtual site"),
    ],
)
def test_what_a_system_refuses(masses: Any, expression: str, indices: list[int], message: str, platform: str) -> None:
    system = particles(*masses)
    if len(masses) == 3:
        system.setVirtualSite(2, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    integrator = VariableStepRattleIntegrator(0.001)
    integrator.addConstraint(expression, indices)
    with pytest.raises(openmm.OpenMMException, match=message):
        open_context(system, integrator, platform)


@pytest.mark.parametrize(
    ("expression", "position", "message"),
    [
        ("x1^2", [0, 0, 0], r"the gradient of expression constraint 1 \(x1\^2 = 0\) of particle 1 is zero"),
        ("sqrt(x1)", [0, 0, 0], "gradient of expression constraint 1 .* is not finite"),
        ("log(x1)", [-1, 0, 0], "expression constraint 1 .* of particle 1 became infinite or not a number"),
        ("y1-z1+x2-1", [1, 0, 0], "constraints among the particles 0 and 1 are redundant"),
        ("1+x1^2", [0.5, 0, 0], "expression constraint 1 .* could not be solved for"),
    ],
)
def test_what_a_start_refuses(expression: str, position: list[float], message: str) -> None:
    integrator = make_integrator()
    integrator.addConstraint("x1-1+y2-z2", [0, 1])
    integrator.addConstraint(expression, [1, 0] if "x2" in expression else [1])
    context = open_context(particles(1, 1, force="x+y"), integrator, "Reference")
    context.setPositions([[1, 0, 0], position])
    with pytest.raises(openmm.OpenMMException, match=message):
        integrator.step(1)
    # The state is as it was, and a better one can be given.
    np.testing.assert_array_equal(positions_of(context)[1], position)


def test_one_particle_held_twice() -> None:
    integrator = make_integrator()
    for expression in ("x1-1", "x1^2-1"):
        integrator.addConstraint(expression, [0])
    context = open_context(particles(1), integrator, "Reference")
    context.setPositions([[1, 0, 0]])
    with pytest.raises(openmm.OpenMMException, match="because the constraints of particle 0 are redundant"):
        integrator.step(1)


# ------------------------------------------------------------------------------------------------------- behaviour


def test_positions_and_velocities_are_projected(platform: str) -> None:
    """The nearest position in the metric of the masses: for one particle along the gradient."""
    integrator, context = on_sphere(platform=platform)
    context.setPositions([[1.2, 0, 1.6]])
    context.setVelocities([[3, 1, 4]])
    energy = integrator.getExpressionConstraintMultiplier(0)  # belongs to the projected state already
    # Tangential velocity (0, 1, 0) + what is left of (3, 0, 4), nothing; weight 20*0.8 along the gradient.
    assert energy == pytest.approx(2.0 * 1.0 - 20 * 0.8, rel=1e-10)
    np.testing.assert_array_equal(positions_of(context), [[1.2, 0, 1.6]])
    integrator.step(1)
    assert np.linalg.norm(positions_of(context)) == pytest.approx(1, abs=1e-12)
    assert abs(positions_of(context)[0] @ velocities_of(context)[0]) < 1e-10


def test_one_force_evaluation_a_step(platform: str) -> None:
    model = general()
    integrator = make_integrator()
    model.constrain(integrator)
    context = open_context(model.system(), integrator, platform, model)
    integrator.step(100)
    assert context.getStepCount() == 100
    assert integrator.getNumForceEvaluations() == 101
    assert integrator.getNumRescues() == 0


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("monitor", ["ConstraintMultipliers", "ConstraintForce", "MultiplierPNorm"])
def test_a_run_is_retraced(update: str, monitor: str) -> None:
    model = general()
    integrator = make_integrator(0.001, update, monitor)
    model.constrain(integrator)
    context = open_context(model.system(), integrator, "Reference", model)
    integrator.step(1)
    before, sizes = positions_of(context), []
    for _ in range(200):
        integrator.step(1)
        sizes.append(integrator.getStepSize()._value)
    integrator.reverse()
    back = []
    for _ in range(200):
        integrator.step(1)
        back.append(integrator.getStepSize()._value)
    np.testing.assert_allclose(positions_of(context), before, rtol=0, atol=1e-8)
    np.testing.assert_allclose(back, sizes[::-1], rtol=1e-9)
    assert max(sizes) > 1.02 * min(sizes)


@pytest.mark.parametrize("update", UPDATES)
def test_errors_are_of_second_order(update: str) -> None:
    model = general()
    ends, drifts = [], []
    for step in (0.0008, 0.0004, 0.0002, 0.00005):
        integrator = make_integrator(step, update)
        model.constrain(integrator)
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.setReferenceMonitorValue(60.0)
        energies = [energy_of(context)]
        while time_of(context) < 0.1:
            integrator.stepTo(min(0.1, time_of(context) + 0.01))
            energies.append(energy_of(context))
        ends.append(positions_of(context))
        drifts.append(max(energies) - min(energies))
    errors = [np.max(np.abs(end - ends[-1])) for end in ends[:-1]]
    # Against a solution with steps of a quarter of the smallest, whose own error is a sixteenth.
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(4.2, rel=0.25)
    assert drifts[0] / drifts[1] == pytest.approx(4, rel=0.4)


def test_scale_of_an_expression_is_of_no_account() -> None:
    """1024 g has the bits of g in everything but multipliers and U2, which are those of g as it is written."""
    runs = []
    for factor in (1.0, 1024.0, 1000.0):
        model = general()
        integrator = make_integrator(monitor="ConstraintAndAppliedForce")
        for c in model.general:
            head, _, definitions = c.expression.partition(";")
            scaled = f"scale*({head});{definitions}".rstrip(";")
            integrator.addConstraint(scaled, c.particles, c.parameters | {"scale": factor})
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.setConstraintTolerance(1e-9)
        integrator.step(100)
        multipliers = np.array(integrator.getMultipliers()._value)
        runs.append((state_of(context), multipliers, integrator.getNumSolverIterations()))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1][:3], runs[1][1][:3])
    np.testing.assert_array_equal(runs[0][1][3:], 1024 * runs[1][1][3:])
    assert runs[0][2] == runs[1][2] == runs[2][2]
    np.testing.assert_allclose(runs[0][0], runs[2][0], rtol=0, atol=1e-9)


def test_multipliers_are_in_order() -> None:
    """Those of the System first, then those that were added, whatever the order inside."""
    system = particles(1, 2, 3, 4, 5, force="x+2*y+3*z")
    system.addConstraint(3, 4, 1.0)
    integrator = make_integrator(monitor="AppliedForce")
    for axis, particle in (("z", 2), ("x", 0), ("y", 1)):
        integrator.addConstraint(f"{axis}1", [particle])
    context = open_context(system, integrator, "Reference")
    context.setPositions([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0]])
    multipliers = integrator.getMultipliers()._value
    # The forces are -1, -2 and -3 along the axes. The masses 4 and 5 would fall along x with -1/4 and -1/5, and a rod
    # of 1 nm between them is under tension by the reduced mass times the difference: 2 Lambda d.
    np.testing.assert_allclose(multipliers[1:], [-3, -1, -2], rtol=1e-12)
    assert multipliers[0] == pytest.approx(4 * 5 / 9 * (1 / 4 - 1 / 5) / 2, rel=1e-12)
    assert [integrator.getExpressionConstraintMultiplier(i) for i in range(3)] == multipliers[1:]


def test_a_fixed_particle_that_is_moved() -> None:
    """A particle without mass is where it is put: the constraint follows."""
    integrator = make_integrator(0.01)
    integrator.addConstraint("sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-1", [0, 1])
    context = open_context(particles(0, 2.0, force="5*z"), integrator, "Reference")
    context.setPositions([[0, 0, 0], [1, 0, 0]])
    context.setVelocities([[9, 9, 9], [0, 1, 0]])  # the first is of no account
    integrator.step(10)
    q = positions_of(context)
    np.testing.assert_array_equal(q[0], [0, 0, 0])
    assert np.linalg.norm(q[1]) == pytest.approx(1, abs=1e-12)
    q[0] = [0.1, 0.2, 0]
    context.setPositions(q)
    integrator.step(10)
    q = positions_of(context)
    np.testing.assert_array_equal(q[0], [0.1, 0.2, 0])
    assert np.linalg.norm(q[1] - q[0]) == pytest.approx(1, abs=1e-12)


def test_sharp_curvature_needs_newton() -> None:
    """Steps that turn by most of a radian, with which the chord iteration does not converge."""
    integrator = make_integrator(0.03, monitor="AppliedForce")
    integrator.addConstraint("x1^4+y1^4-1", [0])
    integrator.addConstraint("z1-x1*y1", [0])
    context = open_context(particles(1.0, force="0.1*x+0.2*y"), integrator, "Reference")
    context.setPositions([[0.2, 1, 0.2]])
    context.setVelocities([[10, 0, 0]])
    counts = [0]
    for _ in range(100):
        integrator.step(1)
        x, y, z = positions_of(context)[0]
        assert x**4 + y**4 == pytest.approx(1, abs=1e-10) and z == pytest.approx(x * y, abs=1e-10)
        counts.append(integrator.getNumSolverIterations())
    # The chord iteration gives up after 12.
    assert max(np.diff(counts)) > 13


def test_velocity_removal_sees_the_constraints() -> None:
    """CMMotionRemover takes away a common velocity, which a constraint to a fixed place may not allow."""
    system = particles(1.0, 2.0, 3.0, force="0.5*x^2")
    system.addForce(openmm.CMMotionRemover())
    integrator = make_integrator(0.01, monitor="AppliedForce")
    integrator.addConstraint("z1-x1", [0])
    context = open_context(system, integrator, "Reference")
    context.setPositions([[0.1, 0, 0.1], [1, 0, 0], [0, 1, 0]])
    context.setVelocities([[1, 0, 1], [0, 1, 1], [1, 0, 2]])
    for _ in range(20):
        integrator.step(1)
        q, v = positions_of(context)[0], velocities_of(context)[0]
        assert q[2] == pytest.approx(q[0], abs=1e-11) and v[2] == pytest.approx(v[0], abs=1e-9)


def test_other_integrators_do_not_keep_it() -> None:
    """What a CompoundIntegrator's other member leaves is brought back onto the constraint, as a start is."""
    compound = openmm.CompoundIntegrator()
    ours = make_integrator(0.01)
    ours.addConstraint(SPHERE, [0], {"r": 1.0})
    ours.setReferenceMonitorValue(20.0)
    compound.addIntegrator(ours)
    compound.addIntegrator(openmm.VerletIntegrator(0.01))
    context = open_context(particles(2.0, force="20*z"), compound, "Reference")
    context.setPositions([[0.6, 0, 0.8]])
    context.setVelocities([[0, 1, 0]])
    for _ in range(5):
        compound.setCurrentIntegrator(0)
        compound.step(3)
        assert np.linalg.norm(positions_of(context)[0]) == pytest.approx(1, abs=1e-11)
        speed = np.linalg.norm(velocities_of(context)[0])
        compound.setCurrentIntegrator(1)
        compound.step(10)
        assert abs(np.linalg.norm(positions_of(context)[0]) - 1) > 1e-3
    # No step had to pull the particle back from where it had no business to be.
    assert speed < 5


def test_a_barostat_moves_it_off() -> None:
    """A barostat scales coordinates, and a plane in space does not scale with them."""
    system = particles(*[40.0] * 20)
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.5)
    for _ in range(20):
        force.addParticle(0, 0.2, 0.1)
    system.addForce(force)
    barostat = openmm.MonteCarloBarostat(100, 300, 2)
    barostat.setRandomNumberSeed(5)
    system.addForce(barostat)
    system.setDefaultPeriodicBoxVectors(*(2 * np.eye(3)))
    integrator = make_integrator(0.002, monitor="AppliedForce")
    integrator.setReferenceMonitorValue(5.0)
    for i in range(5):
        integrator.addConstraint("z1-height", [i], {"height": 1.0 + 0.1 * i})
    context = open_context(system, integrator, "Reference")
    q = np.array([[0.4 * (i % 5) + 0.1, 0.4 * (i // 5) + 0.1, 1.0 + 0.1 * i if i < 5 else 0.2] for i in range(20)])
    context.setPositions(q)
    context.setVelocitiesToTemperature(300, 1)
    boxes = set()
    for _ in range(100):
        integrator.step(1)
        boxes.add(context.getState().getPeriodicBoxVolume()._value)
        np.testing.assert_allclose(positions_of(context)[:5, 2], 1.0 + 0.1 * np.arange(5), rtol=0, atol=1e-11)
    assert len(boxes) > 5


def test_where_nothing_pulls_there_is_no_measure() -> None:
    """The multiplier of a tangential force on a particle at rest is rounding, and no reference value."""
    integrator = make_integrator(0.01)
    integrator.addConstraint("k*(" + SPHERE + ")", [0], {"k": 7.0, "r": 1.3})
    context = open_context(particles(2.0, force="0.8*x-0.6*z"), integrator, "Reference")
    context.setPositions(1.3 * np.array([[0.6, 0, 0.8]]))
    integrator.step(1)
    assert integrator.getStepSize()._value == 0.01
    assert integrator.getReferenceMonitorValue() == 0
    # Now that it moves there is a centripetal force.
    integrator.step(1)
    assert integrator.getReferenceMonitorValue() > 0


# ----------------------------------------------------------------------------------------------- changed in mid-run


def test_a_new_value_takes_effect_at_once(platform: str) -> None:
    integrator, context = on_sphere(platform=platform)
    # Before the first step the positions are moved there, where the multiplier is known without a step.
    integrator.setExpressionParameterValue(0, "r", 1.1 * unit.nanometer)
    z, speed = positions_of(context)[0, 2], 1.0
    expected = 2.0 * speed**2 / 1.1 - 20 * z
    assert integrator.getExpressionConstraintMultiplier(0) == pytest.approx(expected, rel=1e-9)
    integrator.step(20)
    # Afterwards the next step goes there.
    before, v = positions_of(context)[0], velocities_of(context)[0]
    integrator.setExpressionParameterValue(0, "r", 1.102 * unit.nanometer)
    expected = 2.0 * v @ v / 1.1 - 20 * before[2] / 1.1
    assert integrator.getExpressionConstraintMultiplier(0) == pytest.approx(expected, rel=1e-4)
    evaluations = integrator.getNumForceEvaluations()
    integrator.step(1)
    assert integrator.getNumForceEvaluations() == evaluations + 1
    q, v, dt = positions_of(context)[0], velocities_of(context)[0], value(integrator.getStepSize())
    assert np.linalg.norm(q) == pytest.approx(1.102, abs=1e-11)
    assert q @ v / 1.102 == pytest.approx(0.002 / dt, rel=1e-6)
    integrator.setExpressionConstraintParameters(0, SPHERE, [0], {"r": 0.9})
    integrator.step(5)
    assert np.linalg.norm(positions_of(context)[0]) == pytest.approx(0.9, abs=1e-11)


def shorten(steps: int) -> tuple[float, float, float]:
    """A dumbbell that turns, shortened from 0.4 to 0.3 nm within 2 ps: work, change of energy, angular momentum."""
    integrator = VariableStepRattleIntegrator(2 / steps, monitors=[])
    integrator.addConstraint("(x1-x2)^2 + (y1-y2)^2 + (z1-z2)^2 - d^2", [0, 1], {"d": 0.4})
    context = open_context(particles(3.0, 5.0), integrator, "Reference")
    context.setPositions([[0.25, 0, 0], [-0.15, 0, 0]])
    context.setVelocities([[0, 1.0, 0], [0, -0.6, 0]])
    distance, change, work, first = 0.4, -0.1 / steps, 0.0, 0.0
    evaluations = 0
    for step in range(steps):
        before = integrator.getExpressionConstraintMultiplier(0) * -2 * distance  # times dg/dd
        if step == 0:
            evaluations = integrator.getNumForceEvaluations()
        distance += change
        integrator.setExpressionParameterValue(0, "d", distance)
        integrator.step(1)
        if step == 0:
            first = energy_of(context)
        else:
            work += 0.5 * (before + integrator.getExpressionConstraintMultiplier(0) * -2 * distance) * change
    assert integrator.getNumForceEvaluations() == evaluations + steps
    q, v = positions_of(context), velocities_of(context)
    assert (q[0] - q[1]) @ (v[0] - v[1]) / distance == pytest.approx(-0.05, abs=1e-9)
    return work, energy_of(context) - first, np.cross(q, v)[:, 2] @ [3.0, 5.0]


def test_a_constraint_that_moves_does_work() -> None:
    """The work is the change of the energy to second order, and both are as the angular momentum demands."""
    momentum, reduced = 1.2, 15 / 8  # 0.4 nm * 1.6 nm/ps * 15/8 amu
    errors = []
    for steps in (500, 1000, 4000):
        work, change, found = shorten(steps)
        assert found == pytest.approx(momentum, rel=1e-6)
        exact = momentum**2 / (2 * reduced) * (1 / 0.3**2 - 1 / (0.4 - 0.1 / steps) ** 2)
        assert change == pytest.approx(exact, rel=1e-3)
        errors.append(abs(work - change))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)
    assert errors[2] < 1e-4


def test_an_old_value_changes_nothing() -> None:
    ends = []
    for is_set in (False, True):
        integrator, context = on_sphere()
        integrator.step(20)
        if is_set:
            integrator.setExpressionParameterValue(0, "r", 1.0)
        integrator.step(20)
        ends.append(state_of(context))
    np.testing.assert_array_equal(ends[0], ends[1])


def test_a_new_value_is_used_by_a_calibration() -> None:
    integrator, context = on_sphere()
    values = []
    for radius in (1.0, 2.0, 1.0):
        integrator.setExpressionParameterValue(0, "r", radius)
        integrator.calibrate(20)
        values.append(integrator.getReferenceMonitorValue())
    assert values[0] == pytest.approx(values[2], rel=1e-9)
    assert values[1] != pytest.approx(values[0], rel=1e-2)
    np.testing.assert_array_equal(positions_of(context), [[0.6, 0, 0.8]])


def test_a_new_constraint_needs_reinitialize(platform: str) -> None:
    integrator, context = on_sphere(platform=platform)
    integrator.step(5)
    integrator.addConstraint("y1-c", [0], {"c": 0.1})
    for call in (lambda: integrator.step(1), integrator.getMultipliers, integrator.getMonitorValue):
        with pytest.raises(openmm.OpenMMException, match=r"call reinitialize\(preserveState=True\)"):
            call()
    context.reinitialize(preserveState=True)
    integrator.step(5)
    q = positions_of(context)[0]
    assert q[1] == pytest.approx(0.1, abs=1e-11) and np.linalg.norm(q) == pytest.approx(1, abs=1e-11)
    assert len(integrator.getMultipliers()) == 2
    integrator.setExpressionConstraintParameters(1, "z1-c", [0], {"c": -0.5})
    with pytest.raises(openmm.OpenMMException, match="reinitialize"):
        integrator.step(1)
    context.reinitialize(preserveState=True)
    integrator.step(5)
    assert positions_of(context)[0, 2] == pytest.approx(-0.5, abs=1e-11)


# ---------------------------------------------------------------------------------------------------- saved and copied


def assert_same_constraints(a: Any, b: Any) -> None:
    assert a.getNumExpressionConstraints() == b.getNumExpressionConstraints()
    for i in range(a.getNumExpressionConstraints()):
        assert a.getExpressionConstraintParameters(i) == b.getExpressionConstraintParameters(i)


def test_copies_have_the_constraints() -> None:
    model = general()
    original = make_integrator()
    model.constrain(original)
    runs = []
    for duplicate in (
        XmlSerializer.clone(original),
        XmlSerializer.deserialize(XmlSerializer.serialize(original)),
        copy.copy(original),
        copy.deepcopy(original),
        pickle.loads(pickle.dumps(original)),
        original,
    ):
        assert_same_constraints(original, duplicate)
        context = open_context(model.system(), duplicate, "Reference", model)
        duplicate.step(20)
        runs.append(state_of(context))
    for run in runs:
        np.testing.assert_array_equal(run, runs[0])


@pytest.mark.parametrize("update", UPDATES)
def test_a_checkpoint_goes_on_to_the_last_bit(update: str) -> None:
    model = general()
    ends = []
    for interrupted in (False, True):
        integrator = make_integrator(update=update)
        model.constrain(integrator)
        context = open_context(model.system(), integrator, "Reference", model)
        integrator.step(30)
        if interrupted:
            saved = context.createCheckpoint()
            integrator = make_integrator(0.5)
            model.constrain(integrator)
            context = open_context(model.system(), integrator, "Reference", model)
            context.loadCheckpoint(saved)
        integrator.step(30)
        ends.append(state_of(context))
    np.testing.assert_array_equal(ends[0], ends[1])


def test_parameters_come_back_with_a_checkpoint_and_a_state() -> None:
    integrator, context = on_sphere(1.0)
    integrator.step(10)
    checkpoint = context.createCheckpoint()
    state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
    integrator.step(10)
    expected = state_of(context)
    for restore in (lambda c: c.loadCheckpoint(checkpoint), lambda c: c.setState(state)):
        other, other_context = on_sphere(3.0)
        other.step(3)
        restore(other_context)
        assert other.getExpressionConstraintParameters(0)[2] == {"r": 1.0}
        other.step(10)
        np.testing.assert_allclose(state_of(other_context), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "added",
    [[], [("x1+y1+z1-r", [0], {"r": 1.0})], [(SPHERE, [0], {"r": 1.0}), ("y1", [0], {})]],
    ids=["none", "another", "one more"],
)
def test_a_run_with_other_constraints_is_noticed(added: Any) -> None:
    integrator, context = on_sphere(monitor="AppliedForce")
    integrator.step(10)
    checkpoint = context.createCheckpoint()
    state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
    other = make_integrator(0.01, monitor="AppliedForce")
    for arguments in added:
        other.addConstraint(*arguments)
    other_context = open_context(particles(2.0, force="20*z"), other, "Reference")
    other_context.setPositions([[0.6, 0, 0.8]])
    with pytest.raises(openmm.OpenMMException, match="masses or constraints are not those of this one"):
        other_context.loadCheckpoint(checkpoint)
    assert other.getNumExpressionConstraints() == len(added)
    # A State starts the run afresh, with its settings and the constraints that are here.
    other_context.setState(state)
    assert other.getNumExpressionConstraints() == len(added)
    if added:
        other.step(1)
        assert len(other.getMultipliers()) == len(added)
