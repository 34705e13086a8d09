# OpenMM-VRATTLE: the elastic rod of the paper's section 5 against an independent statement and reference states.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import EXPLICIT, SEMI_EXPLICIT, Control, DenseStepper, value
from dense_rod import Rod, gradient_of
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle._constraint_errors import ConstraintErrors
from openmmvrattle.compare.comparison import compare
from openmmvrattle.testsystems import ExpressionConstraint, TestSystem, constraint_error, elastic_rod

REFERENCE = json.loads((Path(__file__).parent / "data" / "rod_reference.json").read_text(encoding="utf-8"))
TIMES = ("0.1", "0.3")
STATE_ACCURACY = 3e-14
"""nm; the reference is good to 1.5e-14, and what is compared with it had better be as well."""


def states() -> list[np.ndarray]:
    """The start, two states on the way, and one far from all constraints: the formulas have to agree anywhere."""
    start = Rod().start
    bent = start + 0.03 * np.random.default_rng(5).normal(size=start.size)
    return [start, *(np.array(REFERENCE[f"q_t{t}"]) for t in TIMES), bent]


def by_kind(multipliers: list[float]) -> np.ndarray:
    """Multipliers in the order of the reference, section by section, put in ours: all distances first."""
    sections = np.array(multipliers).reshape(-1, 6)
    return np.concatenate([sections[:, :3].ravel(), sections[:, 3:].ravel()])


def evaluate(constraint: ExpressionConstraint, q: np.ndarray) -> Any:
    """The value of a constraint's expression, by Python: definitions are used before they stand."""
    points = q.reshape(*q.shape[:-1], -1, 3)[..., list(constraint.particles), :]
    names: dict[str, Any] = dict(constraint.parameters)
    names |= {f"{axis}{k + 1}": points[..., k, a] for k in range(points.shape[-2]) for a, axis in enumerate("xyz")}
    body, *definitions = constraint.expression.replace("^", "**").split(";")
    for definition in reversed(definitions):
        name, expression = definition.split("=")
        names[name.strip()] = eval(expression.strip(), {}, names)
    return eval(body, {}, names)


def constraints_of(rod: TestSystem, q: np.ndarray) -> np.ndarray:
    """g of all constraints, with the values of the rod's own expressions."""
    points = q.reshape(*q.shape[:-1], -1, 3)
    values = []
    for k in range(rod.system.getNumConstraints()):
        i, j, length = rod.system.getConstraintParameters(k)
        values.append(np.sum((points[..., i, :] - points[..., j, :]) ** 2, axis=-1) - length._value**2)
    values += [evaluate(constraint, q) for constraint in rod.expression_constraints]
    return np.stack(values, axis=-1)


def open_forces(rod: TestSystem) -> openmm.Context:
    """A Context for forces and energies alone."""
    return openmm.Context(rod.system, openmm.VerletIntegrator(1e-3), openmm.Platform.getPlatformByName("Reference"))


# ------------------------------------------------------------------------------------------------------- the system


def test_dense_statement_has_the_reference_states() -> None:
    """Energy, multipliers and monitors of the reference; it stands for the rod in the other tests."""
    rod = Rod()
    assert rod.energy(rod.start) == pytest.approx(REFERENCE["V0"], abs=1e-15)
    starts = {"0": (rod.start, rod.start_velocity)}
    starts |= {t: (np.array(REFERENCE[f"q_t{t}"]), np.array(REFERENCE[f"v_t{t}"])) for t in TIMES}
    for time, (q, v) in starts.items():
        energy = REFERENCE["E0" if time == "0" else f"E_t{time}"]
        assert rod.total_energy(q, v) == pytest.approx(energy, abs=1e-14)
        assert np.max(np.abs(rod.g(q))) < 1e-14
        assert np.max(np.abs(rod.jacobian(q) @ v)) < 5e-14
        multipliers = rod.multipliers(q, rod.m3 * v, rod.potential(q)[1])
        np.testing.assert_allclose(multipliers, by_kind(REFERENCE[f"Lambda_t{time}"]), atol=1e-12)
        assert np.linalg.norm(multipliers) == pytest.approx(REFERENCE[f"U2_t{time}"], rel=1e-12)
        assert np.sqrt(multipliers @ rod.matrix(q) @ multipliers) == pytest.approx(REFERENCE[f"UG_t{time}"], rel=1e-12)
        assert rod.nearness(q, 3) == pytest.approx(REFERENCE[f"U3_alpha3_t{time}"], rel=1e-12)


@pytest.mark.parametrize("sections", [2, 10])
def test_start(sections: int) -> None:
    rod, dense = elastic_rod(sections), Rod(sections)
    np.testing.assert_allclose(rod.positions.ravel(), dense.start, atol=1e-15)
    np.testing.assert_allclose(rod.velocities.ravel(), dense.start_velocity, atol=1e-14)
    masses = [rod.system.getParticleMass(i)._value for i in range(rod.system.getNumParticles())]
    np.testing.assert_allclose(masses, dense.masses, rtol=1e-15)
    assert rod.system.getNumConstraints() == len(rod.expression_constraints) == 3 * (sections - 1)


def test_energy_and_forces() -> None:
    """Of OpenMM against those of the dense statement, at rest, bent, twisted, and off the constraints."""
    rod, dense = elastic_rod(), Rod()
    context = open_forces(rod)
    for q in states():
        energy, gradient = dense.potential(q)
        context.setPositions(q.reshape(-1, 3))
        state = context.getState(energy=True, forces=True, groups=rod.force_groups)
        assert state.getPotentialEnergy()._value == pytest.approx(energy, rel=1e-13)
        forces = state.getForces(asNumpy=True)._value.ravel()
        np.testing.assert_allclose(forces[9:], -gradient[9:], rtol=1e-12, atol=1e-13 * np.max(np.abs(gradient)))


def test_forces_are_those_of_the_energy() -> None:
    """Central differences of OpenMM's own energy."""
    rod = elastic_rod()
    context = open_forces(rod)
    q = states()[2]
    direction = np.random.default_rng(3).normal(size=q.size)
    direction[:9] = 0
    step = 1e-5
    energies = []
    for sign in (1, -1):
        context.setPositions((q + sign * step * direction).reshape(-1, 3))
        energies.append(context.getState(energy=True, groups=rod.force_groups).getPotentialEnergy()._value)
    context.setPositions(q.reshape(-1, 3))
    forces = context.getState(forces=True, groups=rod.force_groups).getForces(asNumpy=True)._value.ravel()
    assert (energies[1] - energies[0]) / (2 * step) == pytest.approx(forces @ direction, rel=1e-6)


def test_constraints_and_their_derivatives() -> None:
    """The expressions say what the dense statement says, everywhere and with their first and second derivatives."""
    rod, dense = elastic_rod(), Rod()
    for q in states():
        np.testing.assert_allclose(constraints_of(rod, q), dense.g(q), atol=2e-15)
        jacobian = gradient_of(lambda x: constraints_of(rod, x), q)
        np.testing.assert_allclose(jacobian, dense.jacobian(q), atol=1e-13)
    v = dense.start_velocity
    second = constraints_of(rod, v) - 2 * constraints_of(rod, np.zeros_like(v)) + constraints_of(rod, -v)
    np.testing.assert_allclose(second, dense.second(np.zeros_like(v), v), atol=1e-13)


def test_constraint_error_that_comparisons_measure() -> None:
    """Of the expressions |g| over the norm of its gradient and 0.1 nm, from the dense statement."""
    rod, dense = elastic_rod(), Rod()
    errors = ConstraintErrors(
        rod.system, [(c.expression, c.particles, dict(c.parameters)) for c in rod.expression_constraints]
    )
    assert errors.largest(rod.positions) < 1e-14
    for q in states()[1:]:
        expressions = dense.g(q)[27:]
        gradients = dense.jacobian(q)[27:, 9:]  # the first section has no mass
        expected = np.max(np.abs(expressions) / np.linalg.norm(gradients, axis=1)) / 0.1
        distances = constraint_error(rod.system, q.reshape(-1, 3))
        assert errors.largest(q.reshape(-1, 3)) == pytest.approx(max(expected, distances), rel=1e-10)


def test_start_meets_constraints_that_are_independent() -> None:
    rod = elastic_rod()
    q, v = rod.positions.ravel(), rod.velocities.ravel()
    assert np.max(np.abs(constraints_of(rod, q))) < 1e-14
    jacobian = gradient_of(lambda x: constraints_of(rod, x), q)
    assert np.max(np.abs(jacobian @ v)) < 5e-14
    matrix = Rod().matrix(q)
    assert np.linalg.matrix_rank(matrix) == 54
    assert 550 < np.linalg.cond(matrix) < 1090


def test_constraint_matrix_is_block_tridiagonal() -> None:
    """Six constraints a section, and nothing but neighbours couple."""
    dense = Rod()
    place = np.concatenate([np.repeat(np.arange(9), 3), np.repeat(np.arange(9), 3)])
    apart = np.abs(place[:, None] - place[None, :])
    for q in states():
        matrix = np.abs(dense.matrix(q))
        assert np.max(matrix[apart > 1]) == 0.0
        assert np.min([np.max(matrix[(place[:, None] == i) & (place[None, :] == i + 1)]) for i in range(8)]) > 0.1
    conditions = [np.linalg.cond(dense.matrix(q)) for q in states()[:3]]
    assert 550 < min(conditions) and max(conditions) < 1090


# ------------------------------------------------------------------------------------------------------ the monitor


def test_monitor_is_the_nearness() -> None:
    """The maximum exactly; the smooth form between it and 18^(1/8) times it, the number of its distances."""
    dense = Rod()
    contexts = {kind: open_forces(elastic_rod(monitor=kind)) for kind in ("smooth", "maximum")}
    for q in states():
        energies = {}
        for kind, context in contexts.items():
            context.setPositions(q.reshape(-1, 3))
            energies[kind] = context.getState(energy=True, groups={31}).getPotentialEnergy()._value
        largest = dense.nearness(q, 3)
        assert energies["maximum"] ** 3 == pytest.approx(largest, rel=1e-12)
        assert energies["smooth"] == pytest.approx(np.sum(dense.distances(q) ** -24), rel=1e-11)
        assert largest < energies["smooth"] ** (3 / 24) < 18 ** (1 / 8) * largest * (1 + 1e-12)


def test_monitor_is_no_force() -> None:
    rod = elastic_rod()
    assert rod.monitor_force_group == 31
    integrator = openmm.VerletIntegrator(1e-3)
    rod_without_constraints = TestSystem(**{**vars(rod), "expression_constraints": ()})
    rod_without_constraints.prepare(integrator)
    assert integrator.getIntegrationForceGroups() & 0xFFFFFFFF == rod.force_groups == 0x7FFFFFFF


def test_openmm_cannot_run_it() -> None:
    with pytest.raises(ValueError, match="VerletIntegrator cannot run elastic-rod.*use VariableStepRattleIntegrator"):
        elastic_rod().prepare(openmm.VerletIntegrator(1e-3))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"sections": 1}, "at least 2 sections"),
        ({"length": 0.0}, "length of the rod"),
        ({"length": float("nan")}, "length of the rod"),
        ({"monitor": "sharp"}, "'smooth' or 'maximum'"),
        ({"monitor": "maximum", "sections": 40}, "use 'smooth'"),
    ],
)
def test_rods_that_cannot_be(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        elastic_rod(**arguments)


# ------------------------------------------------------------------------------------------------------- the motion


def open_rod(step: float, kind: str = "", power: float = 1.0, form: str = "smooth", platform: str = "Reference") -> Any:
    """An integrator with at most one monitor and no bounds, and its Context, at the start."""
    rod = elastic_rod(monitor=form)
    integrator = VariableStepRattleIntegrator(step)
    integrator.clearMonitors()
    if kind:
        integrator.addMonitor(getattr(VariableStepRattleIntegrator, kind), 1.0, power)
    integrator.setMinimumStepSize(0)
    integrator.setMaximumStepSize(0)
    integrator.setConstraintTolerance(1e-13)
    rod.prepare(integrator)
    properties = {"Threads": "1"} if platform == "CPU" else {}
    context = openmm.Context(rod.system, integrator, openmm.Platform.getPlatformByName(platform), properties)
    context.setPositions(rod.positions)
    context.setVelocities(rod.velocities)
    return integrator, context, rod


def state_of(context: openmm.Context) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities, flat."""
    state = context.getState(positions=True, velocities=True)
    return state.getPositions(asNumpy=True)._value.ravel(), state.getVelocities(asNumpy=True)._value.ravel()


def test_start_has_the_multipliers_of_the_reference() -> None:
    integrator, context, _ = open_rod(1e-3, "ConstraintMultipliers")
    multipliers = [value(x) for x in integrator.getMultipliers()]
    np.testing.assert_allclose(multipliers, by_kind(REFERENCE["Lambda_t0"]), atol=1e-11)
    assert value(integrator.getMonitorValue()) == pytest.approx(REFERENCE["U2_t0"], rel=1e-12)


def test_rattle_has_the_steps_of_the_reference() -> None:
    """50 steps of 0.002: the same equations, so the same numbers but for rounding and the tolerance."""
    integrator, context, rod = open_rod(0.002)
    energies = []
    for _ in range(50):
        state = context.getState(energy=True, groups=rod.force_groups)
        energies.append(state.getKineticEnergy()._value + state.getPotentialEnergy()._value)
        integrator.step(1)
    np.testing.assert_allclose(state_of(context)[0], REFERENCE["rattle_dt0.002_q_final"], atol=1e-11)
    np.testing.assert_allclose(energies, REFERENCE["rattle_dt0.002_E_n"], atol=1e-11)


def test_vrattle_has_the_steps_of_the_reference(platform: str) -> None:
    """30 steps with U3, whose density starts as in the reference, rho[-1/2] = U(q0), which is not our start.

    With a monitor of the positions alone VRATTLE is RATTLE with steps that are known beforehand.
    """
    integrator, context, rod = open_rod(0.02, form="maximum", platform=platform)
    u = context.getState(energy=True, groups={31}).getPotentialEnergy()._value ** 3
    constant, density, times, densities = 0.02 * u, u, [], []
    for _ in range(30):
        u = context.getState(energy=True, groups={31}).getPotentialEnergy()._value ** 3
        density = 2 * u - density
        densities.append(density)
        integrator.setStepSize(constant / density)
        integrator.step(1)
        times.append(context.getTime()._value)
    name = "vrattle_U3a3_explicit_dt0.02_"
    np.testing.assert_allclose(times, REFERENCE[f"{name}t"], rtol=1e-9)
    np.testing.assert_allclose(densities, REFERENCE[f"{name}rho"], rtol=1e-9)
    np.testing.assert_allclose(state_of(context)[0], REFERENCE[f"{name}q_final"], atol=1e-10)


@pytest.mark.parametrize("form", ["smooth", "maximum"])
def test_nearness_controls_the_steps(form: str) -> None:
    """(3.15) with the monitor's force group, rho + rho' = 2 U, and no force of that group on the rod."""
    power = {"smooth": 3 / 24, "maximum": 3.0}[form]
    integrator, context, rod = open_rod(0.01, "ForceGroupEnergy", power, form)
    densities, values, energies = [], [], []
    for _ in range(200):
        integrator.step(1)
        densities.append(integrator.getStepDensity())
        values.append((integrator.getMonitorValue() / integrator.getReferenceMonitorValue()) ** power)
        state = context.getState(energy=True, groups=rod.force_groups)
        energies.append(state.getKineticEnergy()._value + state.getPotentialEnergy()._value)
    densities, values = np.array(densities), np.array(values)
    np.testing.assert_allclose(densities[1:] + densities[:-1], 2 * values[:-1], rtol=1e-10)
    assert context.getTime()._value > 0.2 and values.max() > 10
    np.testing.assert_allclose(energies, REFERENCE["E0"], atol=1e-3)
    assert integrator.getNumForceEvaluations() == 201 and integrator.getNumRescues() == 0


def extrapolated(time: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities from RATTLE with steps, 2 steps and 4 steps: errors of order two and four removed."""
    rows = []
    for number in (steps, 2 * steps, 4 * steps):
        integrator, context, _ = open_rod(time / number)
        integrator.step(number)
        rows.append(state_of(context))
    results = []
    for kind in range(2):
        coarse, middle, fine = (row[kind] for row in rows)
        first, second = (4 * middle - coarse) / 3, (4 * fine - middle) / 3
        results.append((16 * second - first) / 15)
    return results[0], results[1]


@pytest.mark.parametrize(("time", "steps"), [("0.1", 200), ("0.3", 1200)])
def test_states_of_the_reference(time: str, steps: int) -> None:
    """RATTLE is of order two in even powers, so that runs with 1, 2 and 4 times as many steps give order six."""
    q, v = extrapolated(float(time), steps)
    np.testing.assert_allclose(q, REFERENCE[f"q_t{time}"], atol=STATE_ACCURACY)
    np.testing.assert_allclose(v, REFERENCE[f"v_t{time}"], atol=20 * STATE_ACCURACY)


@pytest.mark.parametrize("kind", ["ConstraintMultipliers", "ConstraintForce"])
@pytest.mark.parametrize("update", [SEMI_EXPLICIT, EXPLICIT])
def test_monitors_of_the_constraints(kind: str, update: str) -> None:
    """U2 and Gauss with expression constraints: four steps of a dense statement with the same first density."""
    integrator, context, _ = open_rod(5e-3, kind)
    integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, update))
    integrator.step(1)
    reference = value(integrator.getReferenceMonitorValue())
    dense = Rod()
    control = Control(5e-3, 0, 0, update, [(kind, 1.0, 1.0)], [reference])
    stepper = DenseStepper(dense, dense.potential, control, dense.start, dense.m3 * dense.start_velocity)
    # The density before the start is what makes the first step the nominal one.
    before = first_density(stepper)
    stepper.set_half(before)
    for n in range(4):
        stepper.step()
        assert integrator.getStepDensity() == pytest.approx(stepper.rho, rel=1e-8), f"step {n + 1}"
        np.testing.assert_allclose(state_of(context)[0], stepper.q, atol=1e-9)
        integrator.step(1)


def first_density(stepper: DenseStepper) -> float:
    """The density before the start with which the first density is 1, by the secant method."""

    def miss(before: float) -> float:
        stepper.set_half(before)
        return stepper.solve()[2] - 1

    low, high = 0.98, 1.02
    at_low, at_high = miss(low), miss(high)
    for _ in range(20):
        if abs(at_high) < 1e-13 or at_high == at_low:
            break
        low, high, at_low = high, high - at_high * (high - low) / (at_high - at_low), at_high
        at_high = miss(high)
    return high


def test_comparison_of_the_rod() -> None:
    """``compare`` gives our integrators their constraints, keeps the monitor's energy out, and says what cannot run."""
    rod = elastic_rod()
    settings = replace(rod.settings, force_evaluations=350, controls=rod.settings.controls[:1])
    comparison = compare(rod, settings=settings)
    assert comparison.initial_energy == pytest.approx(REFERENCE["E0"], abs=1e-12)
    runs = {run.name: run for run in comparison.runs}
    for name in ("VerletIntegrator", "VariableVerletIntegrator"):
        assert f"{name} cannot run elastic-rod" in (runs[name].failure or "")
    variable = runs["VRATTLE, ForceGroupEnergy^0.125"]
    assert variable.failure is None and variable.force_evaluations == pytest.approx(350, rel=0.02)
    assert comparison.gain(variable) == pytest.approx(7.9, rel=0.2)


BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "rod.py"


def run_benchmark(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(BENCHMARK), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.mark.skipif(not BENCHMARK.exists(), reason="needs the folder benchmarks")
def test_benchmark() -> None:
    """A line for each length, in rising order, and a table; what it measures hangs together."""
    result = run_benchmark("--sections", "40", "10", "--repeats", "2")
    assert result.returncode == 0, result.stderr
    lines = [json.loads(line) for line in result.stdout.splitlines() if line.startswith("{")]
    assert [line["sections"] for line in lines] == [10, 40]
    for line in lines:
        assert line["constraints"] == 6 * (line["sections"] - 1)
        assert line["no_forces_seconds"] > 0 and line["whole_seconds"] > 0
        assert line["whole_microseconds_per_section"] == pytest.approx(1e6 * line["whole_seconds"] / line["sections"])
        assert 1 <= line["iterations_per_step"] < 5
    assert lines[0]["whole_relative"] == 1.0
    assert "A step of an elastic rod" in result.stdout


@pytest.mark.skipif(not BENCHMARK.exists(), reason="needs the folder benchmarks")
@pytest.mark.parametrize("arguments", [["--sections", "1"], ["--repeats", "0"]])
def test_benchmark_of_nothing(arguments: list[str]) -> None:
    result = run_benchmark(*arguments)
    assert result.returncode == 2 and "at least" in result.stderr
