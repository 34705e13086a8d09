# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""How far positions are from the constraints of a System and from those that are expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import openmm
from openmm import unit

LENGTH = 0.1
"""What the distance from an expression's zero is divided by, as in setConstraintTolerance(), nm."""
MOST_PARTICLES = 100
"""Expressions of more particles are left out: OpenMM would take minutes for their derivatives."""
Expression = tuple[str, Sequence[int], Mapping[str, float]]
"""What a constraint was added with: the expression, the particles, and the values of the parameters."""


class DistanceConstraints:
    """The distances that a System holds, as arrays."""

    def __init__(self, system: openmm.System) -> None:
        constraints = [system.getConstraintParameters(i) for i in range(system.getNumConstraints())]
        self.first = np.array([c[0] for c in constraints], dtype=int)
        self.second = np.array([c[1] for c in constraints], dtype=int)
        self.distances = np.array([c[2].value_in_unit(unit.nanometer) for c in constraints])
        """nm"""

    def __len__(self) -> int:
        return len(self.distances)

    def errors(self, positions: np.ndarray) -> np.ndarray:
        """The relative error of each distance."""
        lengths = np.linalg.norm(positions[self.first] - positions[self.second], axis=1)
        return np.abs(lengths / self.distances - 1.0)


class ConstraintErrors:
    """The relative errors of the constraints of a run, each in the sense of its tolerance.

    That of an expression g is |g| over the norm of its gradient with respect to the particles that have mass, which is
    their distance from where g = 0, divided by 0.1 nm.
    """

    def __init__(self, system: openmm.System, expressions: Sequence[Expression] = ()) -> None:
        self._distances = DistanceConstraints(system)
        self._system = system
        self._expressions: list[Any] = []
        self._context: openmm.Context | None = None
        self.update(expressions)

    def update(self, expressions: Sequence[Expression]) -> None:
        """Take other expressions, or other values of their parameters."""
        taken = [(text, tuple(particles), dict(values)) for text, particles, values in expressions]
        if taken != self._expressions:
            self._expressions = taken
            self._build([each for each in taken if len(each[1]) <= MOST_PARTICLES])

    def _build(self, expressions: list[Any]) -> None:
        """A Context of copies of the particles, in which the energy is the sum of s*g with s = 1 the x of one more.

        Then the force on that one is -g, and those on the copies are the gradient of g.
        """
        system, forces = openmm.System(), {}
        self._copies = [particle for _, particles, _ in expressions for particle in particles]
        self._sizes = np.array([len(particles) for _, particles, _ in expressions], dtype=int)
        self._context = None
        if not expressions:
            return
        place = 0
        for k, (text, particles, values) in enumerate(expressions):
            key = (text, len(particles), *values)
            if key not in forces:
                last = len(particles) + 1
                forces[key] = openmm.CustomCompoundBondForce(last, f"x{last}*value_of_g; value_of_g = {text}")
                for name in values:
                    forces[key].addPerBondParameter(name)
                system.addForce(forces[key])
            copies = list(range(place, place + len(particles)))
            forces[key].addBond([*copies, len(self._copies) + k], list(values.values()))
            place += len(particles)
        for _ in range(len(self._copies) + len(expressions)):
            system.addParticle(1.0)
        self._moves = np.array([self._system.getParticleMass(particle)._value > 0 for particle in self._copies])
        self._context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))

    def largest(self, positions: np.ndarray) -> float:
        """The largest error at positions in nm; 0 if there is no constraint."""
        errors = [0.0]
        if len(self._distances):
            errors.append(float(np.max(self._distances.errors(positions))))
        if self._context is not None:
            ones = np.zeros((len(self._sizes), 3))
            ones[:, 0] = 1.0
            self._context.setPositions(np.vstack([positions[self._copies], ones]))
            forces = self._context.getState(forces=True).getForces(asNumpy=True)._value
            squares = np.sum(forces[: len(self._copies)] ** 2, axis=1) * self._moves
            starts = np.concatenate([[0], np.cumsum(self._sizes)[:-1]])
            gradients = np.sqrt(np.add.reduceat(squares, starts))
            values = np.abs(forces[len(self._copies) :, 0])
            with np.errstate(divide="ignore", invalid="ignore"):
                errors.append(float(np.max(values / gradients) / LENGTH))
        return float(np.max(errors))  # which is nan if one of them is


def expressions_of(integrator: Any) -> list[Expression]:
    """The expressions that an integrator holds at zero."""
    if not hasattr(integrator, "getNumExpressionConstraints"):
        return []
    return [integrator.getExpressionConstraintParameters(i) for i in range(integrator.getNumExpressionConstraints())]
