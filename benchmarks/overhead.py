# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What a step of VariableStepRattleIntegrator costs beside a step of VerletIntegrator, on real systems; and with
``--langevin`` one of VariableStepRattleLangevinIntegrator beside one of LangevinMiddleIntegrator.

The integrators take turns, a few steps each, so that whatever else the machine does hits them alike; the cost is the
ratio of neighbouring turns, its median and the range of its middle half. The same ratio of the processor time of all
threads depends less on what else there is to do. With ``--alone`` the systems have no nonbonded forces, so that the
integrators' own work is most of what is left. A table and one JSON line a ratio are printed.

    python benchmarks/overhead.py [--langevin] [--alone] [--system water-6000 ...] [--platform CPU] [--rounds 15]

The cost of constant temperature in docs/langevin.md:

    python benchmarks/overhead.py --langevin --system water-24000 villin-all-bonds villin-vacuum --rounds 300
    python benchmarks/overhead.py --langevin --system water-24000 villin-all-bonds villin-vacuum --rounds 100 --alone
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import openmm
import rich.console
import rich.table
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator
from openmmvrattle.testsystems import alanine_dipeptide

STEP, LANGEVIN_STEP = 0.001, 0.002  # ps


def water(box: float) -> tuple[openmm.System, list]:
    """A cube of TIP3P water with PME; the length of its edge is in nm."""
    field = app.ForceField("amber14/tip3p.xml")
    modeller = app.Modeller(app.Topology(), [])
    modeller.addSolvent(field, boxSize=openmm.Vec3(box, box, box) * unit.nanometer)
    system = field.createSystem(modeller.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9, rigidWater=True)
    return system, modeller.positions


def peptide() -> tuple[openmm.System, list]:
    """Alanine dipeptide with bonds to hydrogen fixed, in a box of TIP3P water with PME."""
    molecule = alanine_dipeptide(constraints=app.HBonds)
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    modeller = app.Modeller(molecule.topology, molecule.positions * unit.nanometer)
    modeller.addSolvent(field, boxSize=openmm.Vec3(3, 3, 3) * unit.nanometer)
    system = field.createSystem(
        modeller.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9, constraints=app.HBonds, rigidWater=True
    )
    return system, modeller.positions


def protein(in_water: bool = True) -> tuple[openmm.System, list]:
    """Villin in water with PME, or alone; all its bonds are fixed, which makes one cluster of its 582 atoms."""
    pdb = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    modeller = app.Modeller(pdb.topology, pdb.positions)
    if not in_water:
        modeller.delete([r for r in modeller.topology.residues() if len(list(r.atoms())) <= 3])  # waters and ions
    system = field.createSystem(
        modeller.topology,
        nonbondedMethod=app.PME if in_water else app.NoCutoff,
        nonbondedCutoff=0.9,
        constraints=app.AllBonds,
        rigidWater=True,
    )
    return system, modeller.positions


def without_nonbonded_forces(system: openmm.System) -> openmm.System:
    """What is left of it holds molecules together."""
    for i in reversed(range(system.getNumForces())):
        if isinstance(system.getForce(i), openmm.NonbondedForce):
            system.removeForce(i)
    return system


SYSTEMS: dict[str, Callable[[], tuple[openmm.System, list]]] = {
    "water-6000": lambda: water(3.94),
    "water-24000": lambda: water(6.25),
    "peptide-in-water": peptide,
    "villin-all-bonds": protein,
    "villin-vacuum": lambda: protein(in_water=False),
}


def integrators(langevin: bool) -> dict[str, openmm.Integrator]:
    """OpenMM's first, at the tolerance 1e-6 of its examples; ours at its default of 1e-8, with the default monitor."""
    if langevin:
        middle = openmm.LangevinMiddleIntegrator(300, 1, LANGEVIN_STEP)
        middle.setConstraintTolerance(1e-6)
        return {"LangevinMiddle": middle, "Langevin": VariableStepRattleLangevinIntegrator(300, 1, LANGEVIN_STEP)}
    verlet = openmm.VerletIntegrator(STEP)
    verlet.setConstraintTolerance(1e-6)
    explicit = VariableStepRattleIntegrator(STEP)
    explicit.setUpdateMethod(VariableStepRattleIntegrator.Explicit)
    return {"Verlet": verlet, "Explicit": explicit, "SemiExplicit": VariableStepRattleIntegrator(STEP)}


def quartiles(seconds: list[float], base: list[float]) -> list[float]:
    """Of the ratios of neighbouring turns."""
    return np.quantile(np.array(seconds) / np.array(base), [0.25, 0.5, 0.75]).tolist()


def measure(
    name: str, platform: str, rounds: int, steps: int, threads: int | None, langevin: bool, alone: bool
) -> list[dict]:
    """The steps per second of each integrator, and the ratio of its cost to that of OpenMM's."""
    system, positions = SYSTEMS[name]()
    if alone:
        system = without_nonbonded_forces(system)
    properties = {"Threads": str(threads)} if threads and platform == "CPU" else {}
    start = None
    runs = integrators(langevin)
    base = next(iter(runs))
    contexts = {}
    for label, integrator in runs.items():
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)
        if start is None:
            # One relaxed state for all: no clashes, and velocities of 300 K.
            context.setPositions(positions)
            openmm.LocalEnergyMinimizer.minimize(context, 50, 60)
            context.setVelocitiesToTemperature(300, 1)
            start = context.getState(positions=True, velocities=True)
        context.setPositions(start.getPositions())
        context.setVelocities(start.getVelocities())
        integrator.step(steps)
        contexts[label] = context
    seconds: dict[str, list[float]] = {label: [] for label in runs}
    processor: dict[str, list[float]] = {label: [] for label in runs}
    for turn in range(rounds):
        labels = list(runs)
        for label in labels[turn % len(labels) :] + labels[: turn % len(labels)]:
            begin, begin_processor = time.perf_counter(), time.process_time()
            runs[label].step(steps)
            contexts[label].getState(energy=False)
            seconds[label].append((time.perf_counter() - begin) / steps)
            processor[label].append((time.process_time() - begin_processor) / steps)
    results = []
    for label in runs:
        quarter, median, three_quarters = quartiles(seconds[label], seconds[base])
        result = {
            "benchmark": "overhead",
            "system": name,
            "alone": alone,
            "atoms": system.getNumParticles(),
            "constraints": system.getNumConstraints(),
            "platform": platform,
            "integrator": label,
            "steps_per_second": 1 / statistics.median(seconds[label]),
            "ratio": median,
            "ratio_of_best": min(seconds[label]) / min(seconds[base]),
            "ratio_quarter": quarter,
            "ratio_three_quarters": three_quarters,
            "processor_ms": 1e3 * statistics.median(processor[label]),
            "processor_ratio": quartiles(processor[label], processor[base])[1],
        }
        if label != base:
            result["solver_iterations_per_step"] = runs[label].getNumSolverIterations() / (steps * (rounds + 1))
        results.append(result)
    return results


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--langevin", action="store_true", help="the integrators at constant temperature")
    parser.add_argument("--alone", action="store_true", help="without nonbonded forces")
    parser.add_argument("--system", nargs="+", choices=list(SYSTEMS), default=list(SYSTEMS))
    parser.add_argument("--platform", default="CPU")
    parser.add_argument("--threads", type=int, help="threads of the CPU platform (default: OpenMM's choice)")
    parser.add_argument("--rounds", type=int, default=15, help="turns of each integrator")
    parser.add_argument("--steps", type=int, default=10, help="steps in a turn")
    arguments = parser.parse_args()
    table = rich.table.Table(title="Cost of a step beside that of OpenMM's integrator")
    columns = ("system", "atoms", "integrator", "steps/s", "ratio", "middle half", "best/best", "processor ms", "ratio")
    for column in columns:
        table.add_column(column)
    for name in arguments.system:
        for result in measure(
            name,
            arguments.platform,
            arguments.rounds,
            arguments.steps,
            arguments.threads,
            arguments.langevin,
            arguments.alone,
        ):
            print(json.dumps(result), flush=True)
            table.add_row(
                name,
                str(result["atoms"]),
                result["integrator"],
                f"{result['steps_per_second']:.1f}",
                f"{result['ratio']:.3f}",
                f"{result['ratio_quarter']:.3f} to {result['ratio_three_quarters']:.3f}",
                f"{result['ratio_of_best']:.3f}",
                f"{result['processor_ms']:.2f}",
                f"{result['processor_ratio']:.3f}",
            )
    rich.console.Console(width=120).print(table)


if __name__ == "__main__":
    main()
