# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""How the cost of a step, the memory and the preparation grow with the number of constraints.

Steps of our solver alone, without forces, for rigid waters, proteins with bonds to hydrogen and with all bonds fixed
(many copies of one of 159 residues), and one polymer chain. Beside them, for chains as long as --context says, what
OpenMM's own solver (CCMA) takes: to prepare it, which OpenMM does for every Context of the platforms Reference and CPU,
with whatever integrator (most of an hour for a million bonds), and to constrain the positions and velocities of a step.

A table and one JSON line a measurement are printed. `make scaling` builds the program solver.cpp and runs this.

    python benchmarks/scaling.py --program FILE [--constraints 10000 100000 1000000] [--context 200000 ...]
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import tempfile
import time
from pathlib import Path

import constraints as problems
import numpy as np
import openmm
import rich.console
import rich.table
from openmm import app, unit

GAS_CONSTANT = unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin)
TOLERANCE = 1e-8  # as in solver.cpp


def arrays_of(problem: problems.Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Masses, pairs, lengths and positions of a problem."""
    system = problem.system
    masses = [system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles())]
    first, second, lengths = problems.constraint_arrays(system)
    return np.array(masses), np.stack([first, second], axis=1), lengths, problem.positions


def copies_of(problem: problems.Problem, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As many copies of a problem side by side as have the number of constraints."""
    masses, pairs, lengths, positions = arrays_of(problem)
    copies = max(1, round(count / len(pairs)))
    offsets = len(masses) * np.arange(copies)
    edge = int(np.ceil(copies ** (1 / 3)))
    places = np.stack(
        [np.arange(copies) % edge, np.arange(copies) // edge % edge, np.arange(copies) // edge**2], axis=1
    )
    return (
        np.tile(masses, copies),
        (pairs[None] + offsets[:, None, None]).reshape(-1, 2),
        np.tile(lengths, copies),
        (positions[None] + 5.0 * places[:, None, :]).reshape(-1, 3),
    )


# A system by the number of constraints.
SYSTEMS = {
    "water": lambda count: arrays_of(problems.water(count // 3)),
    "protein-hbonds": lambda count: copies_of(problems.protein(app.HBonds), count),
    "protein-allbonds": lambda count: copies_of(problems.protein(app.AllBonds), count),
    "chain": lambda count: arrays_of(problems.chain(count)),
}


def measure(program: str, name: str, count: int, update: str, threads: int) -> dict:
    """Steps of one system, in a process of its own."""
    masses, pairs, lengths, positions = SYSTEMS[name](count)
    speeds = np.sqrt(GAS_CONSTANT * problems.TEMPERATURE / masses)
    velocities = np.random.default_rng(2).normal(size=positions.shape) * speeds[:, None]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "problem"
        with path.open("wb") as file:
            for array, kind in (
                (np.array([len(masses), len(pairs)]), np.int64),
                (masses, np.float64),
                (pairs, np.int32),
                (lengths, np.float64),
                (positions, np.float64),
                (velocities, np.float64),
            ):
                file.write(np.ascontiguousarray(array, dtype=kind).tobytes())
        steps = max(3, 2_000_000 // len(pairs))
        command = [program, str(path), str(problems.STEP), str(steps), "5", update, str(threads)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    result = json.loads(output)
    return {
        "benchmark": "scaling",
        "system": name,
        "update": update,
        "threads": threads,
        **result,
        "nanoseconds_per_constraint": 1e9 * result["step_seconds"] / result["constraints"],
        "kilobytes_per_constraint": result["kilobytes"] / result["constraints"],
    }


def beside_openmm(program: str, bonds: int) -> dict:
    """A chain prepared and solved by us, on one thread, and by OpenMM's Context, platform Reference, both at 1e-8."""
    ours = measure(program, "chain", bonds, "Explicit", 1)
    problem = problems.chain(bonds)
    begin = time.process_time()
    platform = openmm.Platform.getPlatformByName("Reference")
    context = openmm.Context(problem.system, openmm.VerletIntegrator(problems.STEP), platform)
    prepared = time.process_time() - begin
    speed = np.sqrt(GAS_CONSTANT * problems.TEMPERATURE / problem.system.getParticleMass(0).value_in_unit(unit.dalton))
    context.setPositions(problem.positions)
    context.setVelocities(speed * np.random.default_rng(2).normal(size=problem.positions.shape))
    context.applyVelocityConstraints(1e-12)
    velocities = context.getState(velocities=True).getVelocities(asNumpy=True)
    tangent = velocities.value_in_unit(unit.nanometer / unit.picosecond)
    times = []
    for _ in range(5):
        context.setPositions(problem.positions + problems.STEP * tangent)
        begin = time.process_time()
        context.applyConstraints(TOLERANCE)
        middle = time.process_time() - begin
        achieved = problems.constraint_error(problem.system, problems.positions_of(context))
        context.setVelocities(tangent)
        begin = time.process_time()
        context.applyVelocityConstraints(TOLERANCE)
        times.append(middle + time.process_time() - begin)
    return {
        "benchmark": "scaling-context",
        "bonds": bonds,
        "ours_prepared_seconds": ours["setup_seconds"],
        "openmm_prepared_seconds": prepared,
        "ours_step_seconds": ours["step_seconds"],
        "ours_achieved": ours["error"],
        "openmm_seconds": min(times),
        "openmm_achieved": achieved,
        "ratio": ours["step_seconds"] / min(times),
    }


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", required=True, help="the program made from solver.cpp")
    parser.add_argument("--system", nargs="+", choices=list(SYSTEMS), default=list(SYSTEMS))
    parser.add_argument("--constraints", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--update", nargs="+", choices=["Explicit", "SemiExplicit"], default=["Explicit"])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--context", type=int, nargs="+", default=[], help="bonds of chains to solve with OpenMM too")
    arguments = parser.parse_args()
    table = rich.table.Table(title="A step of the solver alone, at 1e-8")
    columns = ("system", "update", "threads", "constraints", "ns each", "growth", "kB each", "set up (s)", "updates")
    for column in (*columns, "error"):
        table.add_column(column, justify="left" if column in ("system", "update") else "right")
    for name, update, threads in itertools.product(arguments.system, arguments.update, arguments.threads):
        first = None
        for count in arguments.constraints:
            result = measure(arguments.program, name, count, update, threads)
            first = first or result["nanoseconds_per_constraint"]
            result["growth"] = result["nanoseconds_per_constraint"] / first
            print(json.dumps(result), flush=True)
            table.add_row(
                name,
                update,
                str(threads),
                str(result["constraints"]),
                f"{result['nanoseconds_per_constraint']:.1f}",
                f"{result['growth']:.2f}",
                f"{result['kilobytes_per_constraint']:.2f}",
                f"{result['setup_seconds']:.2f}",
                f"{result['iterations_per_step']:.2f}",
                f"{result['error']:.1e}",
            )
    rich.console.Console(width=130).print(table)
    for bonds in arguments.context:
        result = beside_openmm(arguments.program, bonds)
        print(json.dumps(result))
        print(f"A chain of {bonds:,} bonds, ours and OpenMM's:")
        print(f"  prepared in {result['ours_prepared_seconds']:.2f} and {result['openmm_prepared_seconds']:.0f} s")
        print(
            f"  a whole step {1e3 * result['ours_step_seconds']:.2f} ms, error left {result['ours_achieved']:.1e};",
            end=" ",
        )
        print(
            f"constraints {1e3 * result['openmm_seconds']:.2f} ms, error left {result['openmm_achieved']:.1e}:", end=" "
        )
        print(f"ratio {result['ratio']:.2f}")


if __name__ == "__main__":
    main()
