# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What solving the constraints costs, ours beside OpenMM's, at equal achieved error.

Ours is a step of plain RATTLE without forces: the position solve, the velocity projection and the multipliers, and all
that a step does besides. "Alone" is what it takes longer than a step of the same particles without constraints, and is
what the ratio compares; the ratio of the whole step stands beside it. OpenMM's is Context.applyConstraints and
applyVelocityConstraints, that is SETTLE for rigid waters and CCMA for everything else, on the same displaced positions
and the same velocities. Where OpenMM's solver misses an error, its tolerance is tightened as long as that may help.

A table and one JSON line a measurement are printed. How the cost grows with the number of constraints is in scaling.py,
and so is a chain of a million bonds beside OpenMM's solver, of which a Context takes OpenMM most of an hour.

    python benchmarks/constraints.py [--system water ...] [--repeats 7]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import openmm
import rich.console
import rich.table
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator

STEP = 0.001  # ps
TEMPERATURE = 300.0  # K
ERRORS = (1e-5, 1e-8, 1e-12)
CALLS = 7  # of OpenMM's solver in a row
# The sequence of E. coli dihydrofolate reductase, 159 residues, the protein of the usual molecular dynamics benchmarks.
SEQUENCE = (
    "MISLIAALAVDRVIGMENAMPWNLPADLAWFKRNTLNKPVIMGRHTWESIGRPLPGRKNIILSSQPGTDDRVTWVKSVDEAIAACGDV"
    "PEIMVIGGGRVYEQFLPKAQKLYLTHIDAEVEGDTHFPDYEPDDWESVFSEFHDADAQNSHSYCFEILERR"
)
RESIDUES = {
    "A": "ALA", "R": "ARG", "N": "ASN", "D": "ASP", "C": "CYS", "Q": "GLN", "E": "GLU", "G": "GLY", "H": "HIE",
    "I": "ILE", "L": "LEU", "K": "LYS", "M": "MET", "F": "PHE", "P": "PRO", "S": "SER", "T": "THR", "W": "TRP",
    "Y": "TYR", "V": "VAL",
}  # fmt: skip


@dataclass
class Problem:
    """Particles with constraints and no forces."""

    system: openmm.System
    positions: np.ndarray


def without_forces(system: openmm.System) -> openmm.System:
    """The particles and constraints of a System."""
    bare = openmm.System()
    for i in range(system.getNumParticles()):
        bare.addParticle(system.getParticleMass(i))
    for k in range(system.getNumConstraints()):
        bare.addConstraint(*system.getConstraintParameters(k))
    return bare


def water(molecules: int = 8000) -> Problem:
    """Rigid TIP3P waters on a lattice, turned at random."""
    random = np.random.default_rng(1)
    system = openmm.System()
    half = 0.15139006545247014 / 2
    shape = np.array([[0, 0, 0], [half, np.sqrt(0.09572**2 - half**2), 0], [-half, np.sqrt(0.09572**2 - half**2), 0]])
    edge = int(np.ceil(molecules ** (1 / 3)))
    positions = []
    for n in range(molecules):
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        positions.append(0.31 * np.array([n % edge, n // edge % edge, n // edge**2]) + shape @ turn.T)
        for mass in (15.99943, 1.007947, 1.007947):
            system.addParticle(mass)
        for i, j, length in ((0, 1, 0.09572), (0, 2, 0.09572), (1, 2, 2 * half)):
            system.addConstraint(3 * n + i, 3 * n + j, length)
    return Problem(system, np.concatenate(positions))


def chain(bonds: int, masses: tuple[float, ...] = (14.0,), bend: float = 0.6, radius: float = 20.0) -> Problem:
    """A zigzag chain wound up to a wide coil, so that a long one has no large coordinates, whose rounding would show.

    bend is the angle between a bond and the axis, in rad; the masses repeat along the chain.
    """
    system = openmm.System()
    length = 0.153
    turn = 2 * np.arange(bonds + 1) * np.arcsin(length * np.cos(bend) / (2 * radius))
    side = np.where(np.arange(bonds + 1) % 2, 0.5, -0.5) * length * np.sin(bend)
    positions = np.stack([radius * np.cos(turn), radius * np.sin(turn), side + turn / (2 * np.pi) * 0.5], axis=1)
    for i in range(bonds + 1):
        system.addParticle(masses[i % len(masses)])
    # The lengths as they are, so that no start has to move anything.
    for i, distance in enumerate(np.linalg.norm(np.diff(positions, axis=0), axis=1)):
        system.addConstraint(i, i + 1, distance)
    return Problem(system, positions)


def protein(constraints: object) -> Problem:
    """Dihydrofolate reductase by its sequence, Amber force field, unfolded: only bonds and angles matter here."""
    field = app.ForceField("amber14-all.xml")
    topology = app.Topology()
    line = topology.addChain()
    previous = None
    for n, letter in enumerate(SEQUENCE):
        name = RESIDUES[letter]
        template_name = ("N" if n == 0 else "C" if n == len(SEQUENCE) - 1 else "") + name
        template = field._templates[template_name]
        residue = topology.addResidue(name, line)
        atoms = [topology.addAtom(atom.name, atom.element, residue) for atom in template.atoms]
        for i, j in template.bonds:
            topology.addBond(atoms[i], atoms[j])
        by_name = {atom.name: atom for atom in atoms}
        if previous is not None:
            topology.addBond(previous, by_name["N"])
        previous = by_name["C"]
    system = field.createSystem(topology, constraints=constraints)
    # Unfold it: grow from atom to atom, then relax the bonds and angles alone.
    flexible = field.createSystem(topology)
    for index in reversed(range(flexible.getNumForces())):
        if not isinstance(flexible.getForce(index), (openmm.HarmonicBondForce, openmm.HarmonicAngleForce)):
            flexible.removeForce(index)
    neighbours: dict[int, list[int]] = {}
    for a, b in topology.bonds():
        neighbours.setdefault(a.index, []).append(b.index)
        neighbours.setdefault(b.index, []).append(a.index)
    random = np.random.default_rng(3)
    positions = {0: np.zeros(3)}
    queue = [0]
    for atom in queue:
        for other in neighbours[atom]:
            if other not in positions:
                direction = random.normal(size=3) + np.array([1.5, 0, 0])
                positions[other] = positions[atom] + 0.14 * direction / np.linalg.norm(direction)
                queue.append(other)
    context = openmm.Context(flexible, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([positions[i] for i in range(topology.getNumAtoms())])
    openmm.LocalEnergyMinimizer.minimize(context, 0.1, 2000)
    relaxed = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    return Problem(without_forces(system), relaxed)


SYSTEMS: dict[str, tuple[str, Callable[[], Problem]]] = {
    "water": ("SETTLE", lambda: water(8000)),
    "protein-hbonds": ("CCMA", lambda: protein(app.HBonds)),
    "protein-allbonds": ("CCMA", lambda: protein(app.AllBonds)),
    "chain-1500": ("CCMA", lambda: chain(1500)),
    "light-heavy-chain": ("CCMA", lambda: chain(30, masses=(126.9, 1.008), bend=0.02, radius=50.0)),
}


def constraint_error(system: openmm.System, positions: np.ndarray) -> float:
    """The largest relative error of a constrained distance."""
    i, j, length = constraint_arrays(system)
    distances = np.linalg.norm(positions[i] - positions[j], axis=1)
    return float(np.max(np.abs(distances / length - 1)))


def constraint_arrays(system: openmm.System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The particles and lengths of all constraints, kept with the System."""
    if not hasattr(system, "constraint_arrays"):
        rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
        system.constraint_arrays = (
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows]),
            np.array([row[2].value_in_unit(unit.nanometer) for row in rows]),
        )
    return system.constraint_arrays


def positions_of(context: openmm.Context) -> np.ndarray:
    """The positions of a Context in nm."""
    return context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


class Ours:
    """A step of plain RATTLE without forces."""

    def __init__(self, problem: Problem, platform: str) -> None:
        self.system = problem.system
        self.integrator = VariableStepRattleIntegrator(STEP)
        self.integrator.clearMonitors()
        self.integrator.setConstraintTolerance(1e-12)
        self.context = openmm.Context(self.system, self.integrator, openmm.Platform.getPlatformByName(platform))
        self.context.setPositions(problem.positions)
        masses = np.array([self.system.getParticleMass(i)._value for i in range(self.system.getNumParticles())])
        speed = np.sqrt(unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin) * TEMPERATURE)
        random = np.random.default_rng(2)
        self.context.setVelocities(random.normal(size=(len(masses), 3)) * speed / np.sqrt(masses)[:, None])
        # A first step brings positions and velocities onto the constraints; every measurement starts from here.
        self.integrator.setStepSize(1e-6)
        self.integrator.step(1)
        self.integrator.setStepSize(STEP)
        bare = openmm.System()
        for mass in masses:
            bare.addParticle(mass)
        self.bare = VariableStepRattleIntegrator(STEP)
        self.bare.clearMonitors()
        self.bare_context = openmm.Context(bare, self.bare, openmm.Platform.getPlatformByName(platform))
        self.bare_context.setPositions(problem.positions)
        self.bare.step(1)
        state = self.context.getState(positions=True, velocities=True)
        self.positions = state.getPositions(asNumpy=True)._value
        self.velocities = state.getVelocities(asNumpy=True)._value

    def measure(self, error: float, steps: int) -> tuple[float, float, float]:
        """The time of a step, the constraint error after it, and the time of a step without constraints."""
        self.integrator.setConstraintTolerance(error)
        self.integrator.step(1)
        begin = time.perf_counter()
        self.integrator.step(steps)
        middle = time.perf_counter()
        self.bare.step(steps)
        end = time.perf_counter()
        achieved = constraint_error(self.system, positions_of(self.context))
        return (middle - begin) / steps, achieved, (end - middle) / steps


class Theirs:
    """Context.applyConstraints and applyVelocityConstraints."""

    def __init__(self, problem: Problem, platform: str, ours: Ours) -> None:
        self.system = problem.system
        self.ours = ours
        self.context = openmm.Context(
            self.system, openmm.VerletIntegrator(STEP), openmm.Platform.getPlatformByName(platform)
        )

    def solve(self, tolerance: float) -> float:
        """The time of both calls."""
        self.context.setPositions(self.ours.positions + STEP * self.ours.velocities)
        self.context.setVelocities(self.ours.velocities * 1.01)
        begin = time.perf_counter()
        self.context.applyConstraints(tolerance)
        self.context.applyVelocityConstraints(tolerance)
        return time.perf_counter() - begin

    def measure(self, error: float) -> tuple[float, float]:
        """The median time of both calls and the error after them, at the loosest tolerance that reaches the error."""
        tolerance = error
        while True:
            seconds = statistics.median(self.solve(tolerance) for _ in range(CALLS))
            achieved = constraint_error(self.system, positions_of(self.context))
            if achieved <= error or tolerance < 1e-3 * error:
                return seconds, achieved
            tolerance /= 4


def compare(name: str, platform: str, repeats: int) -> list[dict]:
    """Measure one system at each error, the two solvers in turn."""
    solver, make = SYSTEMS[name]
    problem = make()
    ours = Ours(problem, platform)
    theirs = Theirs(problem, platform, ours)
    count = problem.system.getNumConstraints()
    # As many as in a run: threads that have slept take a while to wake up. The first ones find out whether to use them.
    steps = max(1, min(100, 2_000_000 // count))
    ours.integrator.step(100)
    ours.bare.step(100)
    results = []
    for error in ERRORS:
        mine, other = [], []
        for _ in range(repeats):
            mine.append(ours.measure(error, steps))
            other.append(theirs.measure(error))
        result = {
            "benchmark": "constraints",
            "system": name,
            "platform": platform,
            "constraints": count,
            "error": error,
            "ours_step_seconds": statistics.median(m[0] for m in mine),
            "ours_seconds": statistics.median(m[0] - m[2] for m in mine),
            "ours_achieved": max(m[1] for m in mine),
            "their_solver": solver,
            "their_seconds": statistics.median(seconds for seconds, _ in other),
            "their_achieved": max(achieved for _, achieved in other),
            "ratio": statistics.median((a[0] - a[2]) / b[0] for a, b in zip(mine, other, strict=True)),
            "ratio_whole_step": statistics.median(a[0] / b[0] for a, b in zip(mine, other, strict=True)),
        }
        results.append(result)
        print(json.dumps(result), flush=True)
    return results


def show(results: list[dict]) -> None:
    """Print the table."""
    table = rich.table.Table(title="Position solve and velocity projection, at equal error")
    columns = (
        "system",
        "constraints",
        "error",
        "step (ms)",
        "alone (ms)",
        "achieved",
        "OpenMM (ms)",
        "achieved",
        "ratio",
    )
    for column in (*columns, "step ratio"):
        table.add_column(column, justify="left" if column == "system" else "right")
    for r in results:
        table.add_row(
            f"{r['system']} ({r['platform']})",
            str(r["constraints"]),
            f"{r['error']:.0e}",
            f"{1e3 * r['ours_step_seconds']:.3f}",
            f"{1e3 * r['ours_seconds']:.3f}",
            f"{r['ours_achieved']:.1e}",
            f"{1e3 * r['their_seconds']:.3f}",
            f"{r['their_achieved']:.1e}",
            f"{r['ratio']:.2f}",
            f"{r['ratio_whole_step']:.2f}",
        )
    rich.console.Console(width=130).print(table)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--system", nargs="+", choices=list(SYSTEMS), default=list(SYSTEMS))
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    results = []
    for name in arguments.system:
        results += compare(name, "Reference", arguments.repeats)
        if name == "water":
            results += compare(name, "CPU", arguments.repeats)
    show(results)


if __name__ == "__main__":
    main()
