# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The paper's family of solvers for the constraints of a step: how many sweeps or updates does each need?

    python benchmarks/solvers.py [--tolerance 1e-9] [--steps 40] [--every 500] [--page]

For steps along a trajectory of each system, (3.11) is solved from the same start, Lambda(q, p), by

- SOR/Newton: one constraint after the other, each by an update of its own times a factor of relaxation. With the
  factor 1 this is SHAKE; the best of ten factors between 1 and 1.9 is shown as well;
- symmetric Newton: all of them together with the matrix K(q) of the start of the step. That is our chord iteration;
- Newton: all of them together with the true matrix, factorised anew for each update. That is our fall-back.

The mean and the largest number of sweeps or updates are shown. All is in dense NumPy: they are counted and not timed.
With ``--page`` the table goes into docs/method.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import openmm
import pages
from openmm import app
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import (
    TestSystem,
    alanine_dipeptide,
    double_pendulum,
    light_heavy_chain,
    polymer,
    rigid_waters,
)

MOST = 20_000
"""Sweeps after which a solver has failed."""
FACTORS = np.arange(1.0, 1.95, 0.1)
SYSTEMS: dict[str, tuple[Callable[[], TestSystem], float]] = {
    "8 rigid waters, 1 fs": (rigid_waters, 0.001),
    "alanine dipeptide, all bonds, 1 fs": (lambda: alanine_dipeptide(app.AllBonds), 0.001),
    "chain of 30 beads, 2 fs": (polymer, 0.002),
    "I-H-I in a line, 1.25 fs": (light_heavy_chain, 0.00125),
    "double pendulum (1 : 1000), 0.15 fs": (double_pendulum, 0.00015),
}
"""Each with its step in ps."""


@dataclass(frozen=True)
class Step:
    """The equations of one step: sigma(nu) = 0 for the relative errors of squared distances after it."""

    bonds: np.ndarray
    """Pairs of particles."""
    lengths: np.ndarray
    inverse_masses: np.ndarray
    vectors: np.ndarray
    """Between the particles of each bond at the start of the step."""
    drift: np.ndarray
    """Where the particles come to without constraint forces."""
    start: np.ndarray
    """Lambda(q, p), in the unit of nu."""

    def positions(self, nu: np.ndarray) -> np.ndarray:
        """After the step, with these multipliers."""
        moved = self.drift.copy()
        for end, sign in ((0, -1.0), (1, 1.0)):
            particles = self.bonds[:, end]
            np.add.at(moved, particles, sign * self.inverse_masses[particles, None] * nu[:, None] * self.vectors)
        return moved

    def errors(self, positions: np.ndarray) -> np.ndarray:
        """(|r|^2 - L^2)/(2 L^2) of each bond."""
        r = positions[self.bonds[:, 0]] - positions[self.bonds[:, 1]]
        return (np.sum(r * r, axis=1) - self.lengths**2) / (2 * self.lengths**2)

    def matrix(self, positions: np.ndarray) -> np.ndarray:
        """Minus the derivative of the errors with respect to nu, with r from some positions."""
        r = (positions[self.bonds[:, 0]] - positions[self.bonds[:, 1]]) / self.lengths[:, None] ** 2
        count = len(self.bonds)
        result = np.zeros((count, count))
        for end, sign in ((0, 1.0), (1, -1.0)):
            for other, other_sign in ((0, 1.0), (1, -1.0)):
                same = self.bonds[:, end][:, None] == self.bonds[:, other][None, :]
                masses = self.inverse_masses[self.bonds[:, end]][:, None]
                result += sign * other_sign * same * masses * (r @ self.vectors.T)
        return result


def sor(step: Step, tolerance: float, factor: float) -> int | None:
    """How many sweeps SOR/Newton takes; None if it fails."""
    positions = step.positions(step.start)
    for sweep in range(MOST):
        if np.max(np.abs(step.errors(positions))) < tolerance:
            return sweep
        for k, (i, j) in enumerate(step.bonds):
            r = positions[i] - positions[j]
            error = (r @ r - step.lengths[k] ** 2) / 2
            slope = (step.inverse_masses[i] + step.inverse_masses[j]) * (r @ step.vectors[k])
            change = factor * error / slope * step.vectors[k]
            positions[i] -= step.inverse_masses[i] * change
            positions[j] += step.inverse_masses[j] * change
        if not np.all(np.isfinite(positions)):
            return None
    return None


def newton(step: Step, tolerance: float, is_symmetric: bool, old: np.ndarray) -> int | None:
    """How many updates Newton's iteration takes, symmetric or not; None if it fails."""
    nu = step.start.copy()
    for update in range(MOST):
        positions = step.positions(nu)
        errors = step.errors(positions)
        if np.max(np.abs(errors)) < tolerance:
            return update
        if not np.all(np.isfinite(errors)):
            return None
        nu += np.linalg.solve(step.matrix(old if is_symmetric else positions), errors)
    return None


def steps_of(system: TestSystem, size: float, count: int, interval: int) -> list[tuple[Step, np.ndarray]]:
    """Steps along a trajectory with fixed steps, each with the positions at which it starts."""
    openmm_system = system.system
    constraints = [openmm_system.getConstraintParameters(k) for k in range(openmm_system.getNumConstraints())]
    bonds = np.array([(i, j) for i, j, _ in constraints])
    lengths = np.array([length._value for _, _, length in constraints])
    masses = np.array([openmm_system.getParticleMass(i)._value for i in range(openmm_system.getNumParticles())])
    inverse = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    integrator = VariableStepRattleIntegrator(size, monitors=[])
    context = openmm.Context(openmm_system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions(system.positions)
    context.setVelocities(system.velocities)
    result = []
    for _ in range(count):
        integrator.step(interval)
        state = context.getState(positions=True, velocities=True, forces=True)
        q, v, f = (
            values._value
            for values in (state.getPositions(True), state.getVelocities(True), state.getForces(asNumpy=True))
        )
        vectors = q[bonds[:, 0]] - q[bonds[:, 1]]
        # From p(n+1/2) = p - h/2 (grad V + G^T lambda), in which a row of G is twice the vector of the bond.
        start = size**2 * np.array(integrator.getMultipliers()._value)
        drift = q + size * v + size**2 / 2 * inverse[:, None] * f
        result.append((Step(bonds, lengths, inverse, vectors, drift, start), q))
    return result


def measure(name: str, tolerance: float, count: int, interval: int) -> list[str]:
    """A row of the table."""
    make, size = SYSTEMS[name]
    steps = steps_of(make(), size, count, interval)

    def words(numbers: Sequence[int | None]) -> str:
        return "fails" if None in numbers else f"{np.mean(numbers):,.1f}, {max(numbers):,}"

    by_factor = {factor: [sor(step, tolerance, factor) for step, _ in steps] for factor in FACTORS}
    best = min(by_factor, key=lambda factor: sum(MOST if n is None else n for n in by_factor[factor]))
    row = [name, str(len(steps[0][0].bonds)), words(by_factor[1.0]), f"{words(by_factor[best])} (factor {best:.1f})"]
    return row + [
        words([newton(step, tolerance, symmetric, old) for step, old in steps]) for symmetric in (True, False)
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tolerance", type=float, default=1e-9, help="of the relative error of a length")
    parser.add_argument("--steps", type=int, default=40, help="along each trajectory")
    parser.add_argument("--every", type=int, default=500, help="how many steps lie between two of these")
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS), metavar="NAME")
    parser.add_argument("--page", action="store_true", help="put the table into docs/method.md")
    options = parser.parse_args(arguments)
    lines = [
        pages.provenance(),
        "",
        "| system | constraints | SHAKE: sweeps | SOR/Newton: sweeps | symmetric Newton: updates | Newton: updates |",
        "|---|---|---|---|---|---|",
    ]
    for name in options.systems:
        lines.append("| " + " | ".join(measure(name, options.tolerance, options.steps, options.every)) + " |")
        print(lines[-1], flush=True)
    if options.page:
        pages.write(pages.DOCS / "method.md", "solvers", lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
