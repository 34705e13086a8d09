# OpenMM-VRATTLE: random runs with and without looks, restarts and failures: the same to the last bit.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import contextlib
import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import positions_of, velocities_of
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator, XmlSerializer

Kind = VariableStepRattleIntegrator
OF_CONSTRAINTS = (Kind.ConstraintMultipliers, Kind.ConstraintForce, Kind.MultiplierPNorm)
OTHERS = (
    Kind.AppliedForce,
    Kind.ConstraintAndAppliedForce,
    Kind.ForcePNorm,
    Kind.VectorField,
    Kind.MaxForce,
    Kind.ArcLength,
    Kind.MaxParticleArcLength,
    Kind.ForceGroupEnergy,
)


@dataclass
class Case:
    """A System by chance, and how an integrator for it is made."""

    system: openmm.System
    positions: np.ndarray
    velocities: np.ndarray
    make: Callable[[], Any]
    is_langevin: bool
    has_monitors: bool

    def open(self) -> tuple[openmm.Context, Any]:
        integrator = self.make()
        context = openmm.Context(self.system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(self.positions)
        context.setVelocities(self.velocities)
        return context, integrator


def make_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 8))
    system = openmm.System()
    positions = [[0.12 * k, 0.06 * (-1) ** k, 0.03 * rng.normal()] for k in range(n)]
    for _ in range(n):
        system.addParticle(float(rng.choice([1.008, 12, 16])))
    if rng.random() < 0.3:  # one that does not move
        system.addParticle(0)
        positions.append([0.3, 0.3, 0.1])
    fixed = len(positions) - 1
    if n > 2 and rng.random() < 0.4:
        site = system.addParticle(0)
        system.setVirtualSite(site, openmm.ThreeParticleAverageSite(0, 1, 2, 0.4, 0.4, 0.2))
        positions.append([0.0, 0, 0])
    x = np.array(positions)
    for k in range(n - 1):
        if rng.random() < 0.7:
            system.addConstraint(k, k + 1, float(np.linalg.norm(x[k] - x[k + 1])))
    field = openmm.CustomExternalForce("k*((x-0.4)^2+2*y^2+z^2)+80*sin(6*x)")
    field.addGlobalParameter("k", 150)
    for particle in range(len(x)):
        field.addParticle(particle)
    monitor = openmm.CustomBondForce("(0.4/r)^3")
    monitor.addBond(0, n - 1)
    monitor.setForceGroup(31)
    for force in (field, monitor):
        system.addForce(force)

    expressions: list[tuple[str, list[int], float]] = []
    if rng.random() < 0.5:
        point = "sqrt((x1+0.05)^2 + (y1-0.2)^2 + z1^2) - d"
        expressions.append((point, [0], float(np.linalg.norm(x[0] - [-0.05, 0.2, 0]))))
    if n > 3 and rng.random() < 0.5:
        pair = "sqrt((x1-x2)^2 + (y1-y2)^2 + (z1-z2)^2) - d"
        other = fixed if fixed >= n and rng.random() < 0.5 else n - 1
        expressions.append((pair, [1, other], float(np.linalg.norm(x[1] - x[other]))))
    has_constraints = system.getNumConstraints() > 0 or bool(expressions)
    kinds = rng.permutation(OTHERS + OF_CONSTRAINTS if has_constraints else OTHERS)[: rng.integers(1, 4)]
    monitors = [(int(kind), 1.0, float(rng.choice([0.5, 1]))) for kind in kinds]
    way = str(rng.choice(["automatic", "monitors", "fixed", "langevin"]))
    update, size = int(rng.integers(3)), float(rng.choice([0.0003, 0.001]))

    def make() -> Any:
        integrator: Any
        if way == "langevin":
            integrator = VariableStepRattleLangevinIntegrator(300, 2, size, randomNumberSeed=seed + 1)
        elif way == "automatic":
            integrator = VariableStepRattleIntegrator(size)
            integrator.useAutomaticStepControl(8)
        else:
            integrator = VariableStepRattleIntegrator(size, update, monitors=monitors if way == "monitors" else [])
        for expression, particles, distance in expressions:
            integrator.addConstraint(expression, particles, {"d": distance})
        if way != "monitors":
            integrator.setIntegrationForceGroups({0})
        return integrator

    velocities = 0.5 * rng.normal(size=x.shape)
    return Case(system, x, velocities, make, way == "langevin", way in ("automatic", "monitors"))


def arrays_of(context: openmm.Context) -> list[np.ndarray]:
    return [positions_of(context), velocities_of(context)]


def nominal(integrator: Any) -> unit.Quantity:
    is_langevin = isinstance(integrator, VariableStepRattleLangevinIntegrator)
    return integrator.getStepSize() if is_langevin else integrator.getNominalStepSize()


def change(rng: np.random.Generator, case: Case, context: openmm.Context, integrator: Any) -> None:
    """What a user may do in the course of a run."""
    size, temperature, number = nominal(integrator), 250 + 50 * rng.random(), int(rng.integers(10))
    if number == 0:
        context.setParameter("k", 150 + 20 * rng.random())
    elif number == 1 and integrator.getNumExpressionConstraints() > 0:
        distance = integrator.getExpressionConstraintParameters(0)[2]["d"]
        integrator.setExpressionParameterValue(0, "d", distance * (1 + 2e-4 * rng.normal()))
    elif number == 2:
        integrator.setStepSize(size * (0.9 + 0.2 * rng.random()))
    elif number == 3:
        context.setVelocities(arrays_of(context)[1])
    elif number == 4:
        integrator.setConstraintTolerance(10.0 ** -rng.integers(6, 10))
    elif number == 5:
        integrator.setVelocitiesToTemperature(temperature, 3)
    elif case.is_langevin:
        integrator.setTemperature(temperature)
    elif number == 6:
        integrator.stepTo(context.getTime() + 2.3 * size)
    elif number == 7:
        integrator.reverse()
    elif number == 8 and case.has_monitors:
        integrator.setReferenceMonitorValue(1.1 * integrator.getMonitorValue())
    elif number == 9 and integrator.isAutomatic():
        integrator.useAutomaticStepControl(5)


def look(rng: np.random.Generator, case: Case, context: openmm.Context, integrator: Any) -> None:
    """What changes nothing."""
    number = int(rng.integers(10))
    if number == 0:
        integrator.getMultipliers()
    elif number == 1 and (case.has_monitors or case.is_langevin):
        integrator.getMonitorValue()
    elif number == 2:
        integrator.setConstraintTolerance(integrator.getConstraintTolerance())
    elif number == 3 and integrator.getNumExpressionConstraints() > 0:
        integrator.setExpressionConstraintParameters(0, *integrator.getExpressionConstraintParameters(0))
    elif number == 4:
        integrator.setStepSize(nominal(integrator))
    elif number == 5:
        context.getState(energy=True, forces=True, positions=True, groups={0})
    elif number == 6:
        copy.copy(integrator)
        pickle.dumps(integrator)
    elif number == 7:
        context.createCheckpoint()
    elif number == 8:
        context.setTime(context.getTime())
    elif number == 9 and not case.is_langevin:
        integrator.stepTo(context.getTime() - 1 * unit.femtosecond)


def restart(rng: np.random.Generator, case: Case, context: openmm.Context, integrator: Any) -> Any:
    """Go on in another Context, or in this one after Context.reinitialize()."""
    number = int(rng.integers(3))
    if number == 0:
        context.reinitialize(preserveState=True)
        return None
    other, successor = case.open()
    if number == 1:
        other.loadCheckpoint(context.createCheckpoint())
    else:
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        other.setState(XmlSerializer.deserialize(XmlSerializer.serialize(state)))
    return other, successor


def fail(rng: np.random.Generator, case: Case, context: openmm.Context, integrator: Any) -> None:
    """Steps that cannot be taken, and what led to them put back."""
    number, before = int(rng.integers(2)), arrays_of(context)
    with contextlib.ExitStack() as undo:
        if number == 0:
            undo.callback(integrator.setStepSize, nominal(integrator))
            integrator.setStepSize(0)
        elif number == 1 and integrator.getNumExpressionConstraints() > 0:
            distance = integrator.getExpressionConstraintParameters(0)[2]["d"]
            undo.callback(integrator.setExpressionParameterValue, 0, "d", distance)
            integrator.setExpressionParameterValue(0, "d", -1)
        else:
            return
        with pytest.raises(openmm.OpenMMException):
            integrator.step(1)
        for now, then in zip(arrays_of(context), before, strict=True):
            assert np.array_equal(now, then)


def run(seed: int, between: Callable[..., Any] | None) -> list[np.ndarray]:
    case, changes, others = make_case(seed), np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
    context, integrator = case.open()
    results = []
    for block in range(12):
        if block > 0:
            change(changes, case, context, integrator)
            for _ in range(int(others.integers(3)) if between is not None else 0):
                context, integrator = between(others, case, context, integrator) or (context, integrator)
        integrator.step(int(changes.integers(1, 9)))
        results += [*arrays_of(context), np.array(context.getTime()._value)]
    return results


@pytest.mark.parametrize("seed", range(40))
def test_runs_are_the_same_to_the_last_bit(seed: int) -> None:
    plain = run(seed, None)
    for between in (look, restart, fail):
        for expected, found in zip(plain, run(seed, between), strict=True):
            assert np.array_equal(expected, found), between.__name__
