# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What a step of CustomVariableStepRattleIntegrator costs beside those of VerletIntegrator and of the plugin.

The integrators take turns, a few steps each, so that whatever else the machine does hits them alike; the cost is the
ratio of neighbouring turns to VerletIntegrator's, its median and the range of its middle half. A table is printed, and
one JSON line for each integrator.

    python benchmarks/custom.py [--platform CPU] [--precision mixed] [--box 2.5 3.94] [--rounds 11]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import openmm
import rich.console
import rich.table
from openmm import app, unit
from openmmvrattle import CustomVariableStepRattleIntegrator

STEP = 0.001  # ps
MONITORS = {"ConstraintForce": "SemiExplicit", "ConstraintAndAppliedForce": "SemiExplicit", "AppliedForce": "Explicit"}


def water(box: float) -> tuple[openmm.System, openmm.State]:
    """A cube of rigid TIP3P water with PME, without clashes and with velocities of 300 K; its edge is in nm."""
    field = app.ForceField("amber14/tip3p.xml")
    modeller = app.Modeller(app.Topology(), [])
    modeller.addSolvent(field, boxSize=openmm.Vec3(box, box, box) * unit.nanometer)
    system = field.createSystem(modeller.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.9, rigidWater=True)
    context = openmm.Context(system, openmm.VerletIntegrator(STEP), openmm.Platform.getPlatform("CPU"))
    context.setPositions(modeller.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 50, 60)
    context.setVelocitiesToTemperature(300, 1)
    return system, context.getState(positions=True, velocities=True)


def integrators(platform: str) -> dict[str, openmm.Integrator]:
    """Verlet at the tolerance 1e-6 of OpenMM's examples; the plugin, where it has kernels, and ours at their
    defaults."""
    verlet = openmm.VerletIntegrator(STEP)
    verlet.setConstraintTolerance(1e-6)
    result = {"VerletIntegrator": verlet}
    classes: list[tuple[str, Any]] = [("custom", CustomVariableStepRattleIntegrator)]
    if platform in ("Reference", "CPU"):
        from openmmvrattle import VariableStepRattleIntegrator

        classes.insert(0, ("plugin", VariableStepRattleIntegrator))
    for label, cls in classes:
        for kind, update in MONITORS.items():
            result[f"{label}, {kind}"] = cls(STEP, getattr(cls, update), monitors=[getattr(cls, kind)])
    return result


def measure(box: float, platform: str, precision: str, rounds: int, steps: int) -> list[dict[str, Any]]:
    """Seconds a step of each integrator, and the ratio of its cost to VerletIntegrator's."""
    system, start = water(box)
    properties = {} if platform in ("Reference", "CPU") else {"Precision": precision}
    runs, contexts = integrators(platform), {}
    for label, integrator in runs.items():
        context = openmm.Context(system, integrator, openmm.Platform.getPlatform(platform), properties)
        context.setPositions(start.getPositions())
        context.setVelocities(start.getVelocities())
        integrator.step(steps)
        contexts[label] = context
    seconds: dict[str, list[float]] = {label: [] for label in runs}
    for _ in range(rounds):
        for label in runs:
            begin = time.perf_counter()
            runs[label].step(steps)
            contexts[label].getState(velocities=True)  # waits for the device
            seconds[label].append((time.perf_counter() - begin) / steps)
    results = []
    for label, integrator in runs.items():
        ratios = sorted(a / b for a, b in zip(seconds[label], seconds["VerletIntegrator"], strict=True))
        result = {
            "benchmark": "custom",
            "atoms": system.getNumParticles(),
            "platform": platform,
            "precision": precision if properties else "",
            "integrator": label,
            "milliseconds_per_step": 1e3 * statistics.median(seconds[label]),
            "ratio": statistics.median(ratios),
            "ratio_quarter": ratios[len(ratios) // 4],
            "ratio_three_quarters": ratios[-1 - len(ratios) // 4],
        }
        if isinstance(integrator, CustomVariableStepRattleIntegrator):
            result["passes_per_step"] = integrator.getNumSolverIterations() / (steps * (rounds + 1))
        results.append(result)
    return results


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--platform", default="CPU")
    parser.add_argument("--precision", default="mixed", help="of platforms that have a choice")
    parser.add_argument("--box", nargs="+", type=float, default=[2.5, 3.94], help="edges of boxes of water (nm)")
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--steps", type=int, default=5, help="steps in a turn")
    arguments = parser.parse_args()
    table = rich.table.Table(title=f"Cost of a step on {arguments.platform} beside VerletIntegrator's")
    for column in ("atoms", "integrator", "ms a step", "ratio", "middle half", "passes"):
        table.add_column(column)
    for box in arguments.box:
        for r in measure(box, arguments.platform, arguments.precision, arguments.rounds, arguments.steps):
            print(json.dumps(r), flush=True)
            table.add_row(
                str(r["atoms"]),
                r["integrator"],
                f"{r['milliseconds_per_step']:.3g}",
                f"{r['ratio']:.2f}",
                f"{r['ratio_quarter']:.2f} to {r['ratio_three_quarters']:.2f}",
                f"{r['passes_per_step']:.2f}" if "passes_per_step" in r else "",
            )
    rich.console.Console().print(table)


if __name__ == "__main__":
    main()
