# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What constraints given as expressions cost, beside the forces of as many particles.

10,000 expressions hold points on spheres, distances or angles, with as many different parameters. What a step takes
longer than one of the same particles without them is compared with a step of OpenMM's VerletIntegrator that evaluates
the forces of as many particles: Lennard-Jones and reaction field with a cutoff of 1 nm, at the density of liquid argon,
on the same platform in the same run. Steps are measured without forces: fixed ones, those of the explicit update
(3.15), and those of the semi-explicit update (3.14), which evaluates the constraints' curvature more often.

A table and one JSON line a measurement are printed.

    python benchmarks/expressions.py [--number 10000] [--platform Reference CPU] [--repeats 5] [--kind angle ...]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import openmm
import rich.console
import rich.table
from openmmvrattle import VariableStepRattleIntegrator, constraints

STEP = 0.001  # ps
CUTOFF, DENSITY = 1.0, 21.0  # nm, particles/nm^3
UPDATES = {"fixed": None, "explicit": "Explicit", "semi-explicit": "SemiExplicit"}


@dataclass
class Measurement:
    """What was measured for one kind of constraint, times in milliseconds."""

    kind: str
    update: str
    platform: str
    number: int
    particles: int
    step_with: float
    step_without: float
    iterations: float
    forces: float

    @property
    def constraints(self) -> float:
        """What the constraints take of a step (ms)."""
        return self.step_with - self.step_without

    @property
    def ratio(self) -> float:
        """What they take, over one evaluation of the forces of as many particles as there are constraints."""
        return self.constraints / self.forces


def add_sphere(integrator: VariableStepRattleIntegrator, n: int, q: np.ndarray) -> None:
    constraints.fix_to_sphere(integrator, n, (0, 0, 0), float(np.linalg.norm(q[0])))


def add_distance(integrator: VariableStepRattleIntegrator, n: int, q: np.ndarray) -> None:
    constraints.fix_distance(integrator, 2 * n, 2 * n + 1, float(np.linalg.norm(q[0] - q[1])))


def add_angle(integrator: VariableStepRattleIntegrator, n: int, q: np.ndarray) -> None:
    a, b = q[0] - q[1], q[2] - q[1]
    angle = float(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
    constraints.fix_angle(integrator, 3 * n, 3 * n + 1, 3 * n + 2, angle)


# The particles of one constraint, and how to add it.
KINDS: dict[str, tuple[int, Callable[[VariableStepRattleIntegrator, int, np.ndarray], None]]] = {
    "sphere": (1, add_sphere),
    "distance": (2, add_distance),
    "angle": (3, add_angle),
}


def time_forces(number: int, platform: str, repeats: int) -> float:
    """One evaluation of the forces of a liquid of as many particles (ms)."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(CUTOFF)
    edge = int(np.ceil(number ** (1 / 3)))
    spacing = DENSITY ** (-1 / 3)
    system.setDefaultPeriodicBoxVectors(*(np.eye(3) * edge * spacing))
    positions = []
    for n in range(number):
        system.addParticle(39.9)
        force.addParticle(0.1 * (-1) ** n, 0.34, 1.0)
        positions.append(spacing * np.array([n % edge, n // edge % edge, n // edge**2]))
    system.addForce(force)
    context = openmm.Context(system, openmm.VerletIntegrator(STEP), openmm.Platform.getPlatformByName(platform))
    context.setPositions(np.array(positions) + np.random.default_rng(1).normal(size=(number, 3)) * 0.01)
    context.getState(forces=True)
    return measure(lambda: context.getIntegrator().step(1), repeats)


def measure(action: Callable[[], object], repeats: int) -> float:
    """The median time of an action (ms)."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def time_step(
    kind: str, update: str, number: int, platform: str, repeats: int, constrained: bool
) -> tuple[float, float]:
    """A step without forces (ms), and its solver iterations."""
    size, add = KINDS[kind]
    random = np.random.default_rng(2)
    positions = random.normal(size=(number, size, 3))
    system = openmm.System()
    for _ in range(number * size):
        system.addParticle(39.9)
    integrator = VariableStepRattleIntegrator(STEP, monitors=[])
    if constrained:
        for n in range(number):
            add(integrator, n, positions[n])
        if UPDATES[update] is not None:
            integrator.addMonitor(VariableStepRattleIntegrator.ConstraintForce)
            integrator.setUpdateMethod(getattr(VariableStepRattleIntegrator, UPDATES[update]))
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
    context.setPositions(positions.reshape(-1, 3))
    context.setVelocities(random.normal(size=(number * size, 3)) * 0.25)  # 300 K
    integrator.step(60)  # until the number of threads has been chosen
    before, steps = integrator.getNumSolverIterations(), 10
    elapsed = measure(lambda: integrator.step(steps), repeats) / steps
    return elapsed, (integrator.getNumSolverIterations() - before) / (steps * repeats)


def run(kind: str, update: str, number: int, platform: str, repeats: int, forces: float) -> Measurement:
    """Measure one kind of constraint with one update."""
    with_constraints, iterations = time_step(kind, update, number, platform, repeats, True)
    without, _ = time_step(kind, update, number, platform, repeats, False)
    particles = number * KINDS[kind][0]
    return Measurement(kind, update, platform, number, particles, with_constraints, without, iterations, forces)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=10000)
    parser.add_argument("--platform", nargs="+", default=["Reference", "CPU"])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    arguments = parser.parse_args()
    table = rich.table.Table(title=f"{arguments.number} expression constraints")
    for column in ("platform", "kind", "step", "iterations", "constraints (ms)", "us each", "forces (ms)", "ratio"):
        table.add_column(column, justify="left" if column in ("platform", "kind", "step") else "right")
    for platform in arguments.platform:
        forces = time_forces(arguments.number, platform, arguments.repeats)
        for kind in arguments.kind:
            for update in UPDATES:
                m = run(kind, update, arguments.number, platform, arguments.repeats, forces)
                print(json.dumps(asdict(m) | {"constraints": m.constraints, "ratio": m.ratio}))
                each = 1e3 * m.constraints / m.number
                row = (
                    f"{m.iterations:.1f}",
                    f"{m.constraints:.2f}",
                    f"{each:.2f}",
                    f"{m.forces:.1f}",
                    f"{m.ratio:.2f}",
                )
                table.add_row(platform, kind, update, *row)
    rich.console.Console(width=110).print(table)


if __name__ == "__main__":
    main()
