# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""How the time of a step and the memory grow with the length of an elastic rod, from 10 to 10,000 sections.

The rod has three distances and three expression constraints a section, and only neighbours are coupled: K is block
tridiagonal with blocks of 6 x 6, so that a step should cost the same time per section whatever their number. All rods
have the same sections of 0.1 nm, and their ends the same speed. "Whole" is a step of plain RATTLE with the forces of
the rod, "no forces" the same constraints without any force: what the constraints and the step itself cost. The two are
measured in turn, each length in a process of its own; of many short repetitions the fastest counts. "Relative" is the
time per section divided by that of 100 sections, for with 10 the overhead of a call still shows.

    python benchmarks/rod.py [--sections 10 100 1000 10000] [--repeats 25] [--platform Reference|CPU]
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from typing import Any

import openmm
import rich.console
import rich.table
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import TestSystem, elastic_rod

STEP = 1e-3  # ps
SECONDS = 0.03
"""How long one repetition takes, about."""
BASE = 100
"""The number of sections with which the others are compared."""


def open_rod(rod: TestSystem, system: openmm.System, platform: str) -> tuple[Any, openmm.Context]:
    """The integrator and the Context of a rod, with the forces of the given System, after its first steps."""
    integrator = VariableStepRattleIntegrator(STEP)
    integrator.clearMonitors()
    rod.prepare(integrator)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
    context.setPositions(rod.positions)
    context.setVelocities(rod.velocities)
    integrator.step(3)
    return integrator, context


def without_forces(system: openmm.System) -> openmm.System:
    """The particles and distance constraints of a System."""
    bare = openmm.System()
    for i in range(system.getNumParticles()):
        bare.addParticle(system.getParticleMass(i))
    for k in range(system.getNumConstraints()):
        bare.addConstraint(*system.getConstraintParameters(k))
    return bare


def memory() -> int:
    """The memory that this process has used at most so far, in kB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def seconds_a_step(integrator: Any, steps: int) -> float:
    """The time of a step, from several."""
    begin = time.perf_counter()
    integrator.step(steps)
    return (time.perf_counter() - begin) / steps


def measure(sections: int, repeats: int, platform: str) -> dict[str, Any]:
    """The measurements of one length, in this process."""
    rod = elastic_rod(sections, 0.1 * sections, 32.0 / sections)
    bare_system = without_forces(rod.system)
    before = memory()
    begin = time.perf_counter()
    bare, bare_context = open_rod(rod, bare_system, platform)
    preparation = time.perf_counter() - begin
    used = memory() - before
    whole, whole_context = open_rod(rod, rod.system, platform)
    integrators = {"no_forces": bare, "whole": whole}
    steps = {name: max(1, math.ceil(SECONDS / seconds_a_step(one, 2))) for name, one in integrators.items()}
    # At most half a picosecond of the motion in all: the rod stays away from hard collisions.
    steps = {name: max(1, min(number, 500 // repeats)) for name, number in steps.items()}
    times: dict[str, list[float]] = {name: [] for name in integrators}
    for _ in range(repeats):
        for name, integrator in integrators.items():
            times[name].append(seconds_a_step(integrator, steps[name]))
    iterations = whole.getNumSolverIterations() / (whole.getNumForceEvaluations() - 1)
    del bare_context, whole_context
    return {
        "benchmark": "rod",
        "platform": platform,
        "sections": sections,
        "constraints": 6 * (sections - 1),
        "whole_seconds": min(times["whole"]),
        "no_forces_seconds": min(times["no_forces"]),
        "whole_microseconds_per_section": 1e6 * min(times["whole"]) / sections,
        "no_forces_microseconds_per_section": 1e6 * min(times["no_forces"]) / sections,
        "iterations_per_step": iterations,
        "first_steps_seconds": preparation,
        "kilobytes_per_section": used / sections,
    }


def add_ratios(results: list[dict[str, Any]]) -> None:
    """The time per section relative to that of the base length, or of the shortest if that was not measured."""
    base = next((r for r in results if r["sections"] == BASE), results[0])
    for result in results:
        for part in ("whole", "no_forces"):
            name = f"{part}_microseconds_per_section"
            result[f"{part}_relative"] = result[name] / base[name]


def show(results: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = rich.table.Table(title=f"A step of an elastic rod, platform {results[0]['platform']}")
    columns = ("sections", "constraints", "whole (ms)", "µs a section", "relative")
    columns += ("no forces (ms)", "µs a section", "relative", "iterations", "kB a section")
    for column in columns:
        table.add_column(column, justify="right")
    for r in results:
        table.add_row(
            f"{r['sections']:,}",
            f"{r['constraints']:,}",
            f"{1e3 * r['whole_seconds']:.3f}",
            f"{r['whole_microseconds_per_section']:.2f}",
            f"{r['whole_relative']:.2f}",
            f"{1e3 * r['no_forces_seconds']:.3f}",
            f"{r['no_forces_microseconds_per_section']:.2f}",
            f"{r['no_forces_relative']:.2f}",
            f"{r['iterations_per_step']:.2f}",
            f"{r['kilobytes_per_section']:.1f}",
        )
    rich.console.Console(width=130).print(table)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sections", type=int, nargs="+", default=[10, 100, 1_000, 10_000])
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--platform", default="Reference")
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if min(arguments.sections) < 2 or arguments.repeats < 1:
        parser.error("a rod has at least 2 sections, and there is at least one repetition")
    if arguments.case:
        print(json.dumps(measure(arguments.case, arguments.repeats, arguments.platform)))
        return
    results = []
    for sections in sorted(arguments.sections):
        command = [sys.executable, __file__, "--case", str(sections), "--repeats", str(arguments.repeats)]
        command += ["--platform", arguments.platform]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        results.append(json.loads(output))
    add_ratios(results)
    for result in results:
        print(json.dumps(result), flush=True)
    show(results)


if __name__ == "__main__":
    main()
