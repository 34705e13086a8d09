# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Steps per second on a GPU, beside OpenMM's integrators.

The integrators take turns in one run, and the ratio to VerletIntegrator is that of neighbouring turns (median). Beside
it stand the error of the constraints afterwards and, with --energy, how well energy is kept. For OpenMM's integrators
constraints have the tolerance 1e-6 (1e-5 in single precision), for ours 1e-8, their default, or what --tolerance says.

    python benchmarks/gpu.py [--platform CUDA] [--precision mixed single] [--system water6k water24k villin]
    python benchmarks/gpu.py --data FOLDER --system dhfr dhfr-allbonds

FOLDER has water6k.npz (`pos` and `box`, nm), dhfr.npz (`pos`) and the Systems dhfr.xml.gz (bonds to hydrogen rigid),
dhfr_ab.xml.gz (all bonds) and dhfr_ha.xml.gz (angles of hydrogens too). Without it boxes of water are made from the
force field, and villin takes DHFR's place.
The same program measures the CPU platform: --platform CPU --threads 16.
"""

from __future__ import annotations

import argparse
import gzip
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app, unit
from openmmvrattle import (
    CustomVariableStepRattleIntegrator,
    VariableStepRattleIntegrator,
    VariableStepRattleLangevinIntegrator,
)

Loaded = tuple[openmm.System, np.ndarray]
GPU_PLATFORMS = ("CUDA", "OpenCL", "HIP")
CUTOFF = 0.9  # nm
BEGIN = time.perf_counter()


def say(text: str) -> None:
    print(text, flush=True)


# ---------------------------------------------------------------------------------------------------------- the systems


def water_cell(data: Path | None, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions (O, H, H and so on) of a small box of water, and its edges (nm)."""
    if data is not None:
        stored = np.load(data / "water6k.npz")
        return stored["pos"], np.diag(stored["box"])
    modeller = app.Modeller(app.Topology(), [])
    modeller.addSolvent(app.ForceField("amber14/tip3p.xml"), boxSize=openmm.Vec3(edge, edge, edge) * unit.nanometer)
    return np.array(modeller.positions.value_in_unit(unit.nanometer)), np.full(3, edge)


def water(data: Path | None, tiles: tuple[int, int, int], edge: float = 3.94, cutoff: float = CUTOFF) -> Loaded:
    """Rigid TIP3P water with PME: a small box repeated."""
    cell, edges = water_cell(data, edge)
    field = app.ForceField("amber14/tip3p.xml")
    topology = app.Topology()
    topology.setPeriodicBoxVectors(np.diag(edges * tiles).tolist() * unit.nanometer)
    chain = topology.addChain()
    offsets = [np.array((i, j, k)) for i in range(tiles[0]) for j in range(tiles[1]) for k in range(tiles[2])]
    for _ in range(len(offsets) * len(cell) // 3):
        residue = topology.addResidue("HOH", chain)
        oxygen, *hydrogens = (
            topology.addAtom(name, app.Element.getBySymbol(name[0]), residue) for name in ("O", "H1", "H2")
        )
        for hydrogen in hydrogens:
            topology.addBond(oxygen, hydrogen)
    system = field.createSystem(
        topology, nonbondedMethod=app.PME, nonbondedCutoff=cutoff, rigidWater=True, removeCMMotion=False
    )
    return system, np.concatenate([cell + edges * offset for offset in offsets])


def dhfr(data: Path | None, name: str) -> Loaded:
    """Dihydrofolate reductase in water, 23,558 atoms, as in OpenMM's own benchmark."""
    if data is None:
        raise SystemExit("dhfr and dhfr-allbonds need --data; villin and villin-allbonds do not")
    with gzip.open(data / f"{name}.xml.gz", "rt") as file:
        system = openmm.XmlSerializer.deserialize(file.read())
    for index in reversed(range(system.getNumForces())):
        if isinstance(system.getForce(index), openmm.CMMotionRemover):
            system.removeForce(index)
    return system, np.load(data / "dhfr.npz")["pos"]


def villin(constraints: Any) -> Loaded:
    """The protein villin in water, 8,867 atoms, which comes with OpenMM."""
    file = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
    system = app.ForceField("amber14-all.xml", "amber14/tip3p.xml").createSystem(
        file.topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=CUTOFF,
        constraints=constraints,
        rigidWater=True,
        removeCMMotion=False,
    )
    return system, file.getPositions(asNumpy=True).value_in_unit(unit.nanometer)


def chains(are_all_rigid: bool) -> Loaded:
    """A layer of 128 chains C43H88, each with 130 bonds; those to hydrogen or all of them are rigid."""
    carbons, spacing, carbon_bond, hydrogen_bond = 43, 0.5, 0.1529, 0.109
    system, positions = openmm.System(), []
    nonbonded, bonds, angles = openmm.NonbondedForce(), openmm.HarmonicBondForce(), openmm.HarmonicAngleForce()
    pairs = []

    def bind(i: int, j: int, length: float) -> None:
        pairs.append((i, j))
        if are_all_rigid or length == hydrogen_bond:
            system.addConstraint(i, j, length)
        else:
            bonds.addBond(i, j, length, 224262.4)

    tetrahedral = np.arccos(-1 / 3)
    up, out = carbon_bond * np.sin(tetrahedral / 2), carbon_bond * np.cos(tetrahedral / 2)
    side, away = hydrogen_bond * np.sin(tetrahedral / 2), hydrogen_bond * np.cos(tetrahedral / 2)
    for column, row in np.ndindex(16, 8):
        last = None
        for k in range(carbons):
            place = np.array(((column + 0.5) * spacing, (row + 0.5) * spacing + (k % 2) * out, 0.5 + k * up))
            outwards = away if k % 2 else -away
            carbon = system.addParticle(12.011)
            nonbonded.addParticle(0, 0.35, 0.276)
            positions.append(place)
            offsets = [np.array((sign * side, outwards, 0)) for sign in (-1, 1)]
            if k in (0, carbons - 1):
                offsets.append(
                    np.array(
                        (0, -outwards / away * hydrogen_bond / 3, np.sqrt(8) / 3 * hydrogen_bond * (1 if k else -1))
                    )
                )
            for offset in offsets:
                hydrogen = system.addParticle(1.008)
                nonbonded.addParticle(0, 0.25, 0.126)
                positions.append(place + offset)
                bind(carbon, hydrogen, hydrogen_bond)
            if last is not None:
                bind(last, carbon, carbon_bond)
            last = carbon
    neighbours: dict[int, list[int]] = {}
    for i, j in pairs:
        neighbours.setdefault(i, []).append(j)
        neighbours.setdefault(j, []).append(i)
    for centre, ends in neighbours.items():
        for n, i in enumerate(ends):
            for j in ends[:n]:
                angles.addAngle(i, centre, j, tetrahedral, 350)
    nonbonded.createExceptionsFromBonds(pairs, 1, 0.5)
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    nonbonded.setCutoffDistance(CUTOFF)
    for force in (nonbonded, bonds, angles):
        system.addForce(force)
    edges = np.array((16 * spacing, 8 * spacing, 1 + carbons * up))
    system.setDefaultPeriodicBoxVectors(*np.diag(edges))
    return system, np.array(positions)


SYSTEMS: dict[str, Callable[[Path | None], Loaded]] = {
    "water-small": lambda data: water(None, (1, 1, 1), 1.6, 0.7),
    "water6k": lambda data: water(data, (1, 1, 1)),
    "water24k": lambda data: water(data, (2, 2, 1)),
    "water96k": lambda data: water(data, (4, 2, 2)),
    "dhfr": lambda data: dhfr(data, "dhfr"),
    "dhfr-allbonds": lambda data: dhfr(data, "dhfr_ab"),
    "dhfr-hangles": lambda data: dhfr(data, "dhfr_ha"),
    "chains": lambda data: chains(False),
    "chains-allbonds": lambda data: chains(True),
    "villin": lambda data: villin(app.HBonds),
    "villin-allbonds": lambda data: villin(app.AllBonds),
}


def equilibrated(system: openmm.System, positions: np.ndarray, context_of: Callable, steps: int) -> openmm.State:
    """A state of 300 K."""
    integrator = openmm.LangevinMiddleIntegrator(300, 20, 0.0005)
    integrator.setConstraintTolerance(1e-6)
    context = context_of(system, integrator)
    context.setPositions(positions)
    context.applyConstraints(1e-6)
    context.setVelocitiesToTemperature(300, 1)
    integrator.step(steps)
    context.applyConstraints(1e-6)
    context.applyVelocityConstraints(1e-6)
    return context.getState(positions=True, velocities=True, forces=True)


def masses_of(system: openmm.System) -> np.ndarray:
    return np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])


def constraint_error(system: openmm.System, context: openmm.Context) -> float:
    """The largest relative error of a constrained distance."""
    positions = context.getState(positions=True).getPositions(asNumpy=True)._value
    rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    first, second = (np.array([row[i] for row in rows]) for i in (0, 1))
    lengths = np.array([row[2]._value for row in rows])
    return float(np.max(np.abs(np.linalg.norm(positions[first] - positions[second], axis=1) / lengths - 1)))


# ------------------------------------------------------------------------------------------------------ the integrators


def integrators(step: float, state: openmm.State, system: openmm.System, single: bool, tolerance: float) -> dict:
    """Functions that make them, by name."""
    ours, custom = VariableStepRattleIntegrator, CustomVariableStepRattleIntegrator
    coarse = 1e-5 if single else 1e-6
    # For steps of about the same size: it divides this by the forces.
    masses = masses_of(system)
    moving = masses > 0
    forces = state.getForces(asNumpy=True)._value
    error = step**2 * float(np.sqrt(np.mean((forces[moving] / masses[moving, None]) ** 2)))

    def with_tolerance(make: Callable[[], openmm.Integrator], value: float) -> Callable[[], openmm.Integrator]:
        def made() -> openmm.Integrator:
            integrator = make()
            integrator.setConstraintTolerance(value)
            return integrator

        return made

    return {
        "Verlet": with_tolerance(lambda: openmm.VerletIntegrator(step), coarse),
        "VariableVerlet": with_tolerance(lambda: openmm.VariableVerletIntegrator(error), coarse),
        "LangevinMiddle": with_tolerance(lambda: openmm.LangevinMiddleIntegrator(300, 1, step), coarse),
        "Langevin": with_tolerance(lambda: VariableStepRattleLangevinIntegrator(300, 1, step), tolerance),
        "fixed": with_tolerance(lambda: ours(step, monitors=[]), tolerance),
        "Explicit": with_tolerance(lambda: ours(step, ours.Explicit), tolerance),
        "Bounded": with_tolerance(lambda: ours(step, ours.Bounded), tolerance),
        "SemiExplicit": with_tolerance(lambda: ours(step), tolerance),
        "automatic": with_tolerance(lambda: ours(step, automatic=True), tolerance),
        "custom": with_tolerance(lambda: custom(step, monitors=[custom.ConstraintAndAppliedForce]), coarse),
    }


class Run:
    """An integrator in a Context of its own."""

    def __init__(self, system: openmm.System, integrator: openmm.Integrator, state: openmm.State, context_of: Callable):
        self.integrator = integrator
        self.context = context_of(system, integrator)
        self.context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        self.context.setPositions(state.getPositions())
        self.context.setVelocities(state.getVelocities())

    def wait(self) -> None:
        self.context.getState(positions=True)

    def seconds(self, calls: int, steps: int) -> float:
        """The time that a step takes when step(steps) is called so many times."""
        self.wait()
        begin = time.perf_counter()
        for _ in range(calls):
            self.integrator.step(steps)
        self.wait()
        return (time.perf_counter() - begin) / (calls * steps)


def describe(integrator: openmm.Integrator) -> dict[str, Any]:
    """What is to be known of a run of ours."""
    if isinstance(integrator, VariableStepRattleLangevinIntegrator):
        return {
            "force_evaluations": integrator.getNumForceEvaluations(),
            "solver_iterations": integrator.getNumSolverIterations(),
            "substepped": integrator.getNumSubstepped(),
        }
    if not isinstance(integrator, VariableStepRattleIntegrator):
        return {}
    return {
        "force_evaluations": integrator.getNumForceEvaluations(),
        "solver_iterations": integrator.getNumSolverIterations(),
        "rescues": integrator.getNumRescues(),
    }


# ----------------------------------------------------------------------------------------------------- the measurements


def measure_speed(runs: dict[str, Run], steps: int, seconds: float, rounds: int) -> dict[str, list[float]]:
    """The time of a step in each round, when step(steps) is called; a run that fails is dropped."""
    found: dict[str, list[float]] = {name: [] for name in runs}
    calls: dict[str, int] = {}
    names = list(runs)
    for turn in range(-1, rounds):
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            if name not in runs:
                continue
            try:
                if turn < 0:
                    runs[name].seconds(2, steps)
                    calls[name] = max(1, round(seconds / (steps * runs[name].seconds(1, steps))))
                else:
                    found[name].append(runs[name].seconds(calls[name], steps))
            except openmm.OpenMMException as error:
                say(f"   {name} failed: {error}")
                del runs[name], found[name]
    return found


def measure_energy(run: Run, duration: float, samples: int) -> dict[str, float]:
    """How the energy moves over some time (ps): the scatter about a straight line, and its slope."""
    steps = max(1, round(duration / run.integrator.getStepSize()._value / samples))
    times, energies = [], []
    for _ in range(samples):
        run.integrator.step(steps)
        state = run.context.getState(energy=True)
        times.append(state.getTime()._value)
        energies.append(state.getPotentialEnergy()._value + state.getKineticEnergy()._value)
    line = np.polyfit(times, energies, 1)
    return {
        "energy_scatter": float(np.std(np.array(energies) - np.polyval(line, times))),
        "energy_drift": float(line[0]),
        "time": times[-1] - times[0],
    }


def measure(name: str, precision: str, options: argparse.Namespace) -> None:
    """All of one system: print it, and add a line for each number to the file."""
    begin = time.perf_counter()
    platform = openmm.Platform.getPlatform(options.platform)
    properties = {"Precision": precision} if options.platform in GPU_PLATFORMS else {}
    if options.threads and options.platform == "CPU":
        properties["Threads"] = str(options.threads)

    def context_of(system: openmm.System, integrator: openmm.Integrator) -> openmm.Context:
        return openmm.Context(system, integrator, platform, properties)

    def elapsed() -> str:
        return f"{time.perf_counter() - begin:.1f} s"

    system, positions = SYSTEMS[name](options.data)
    state = equilibrated(system, positions, context_of, options.equilibrate)
    head = {
        "benchmark": "gpu",
        "system": name,
        "atoms": system.getNumParticles(),
        "constraints": system.getNumConstraints(),
        "platform": options.platform,
        "precision": precision if options.platform in GPU_PLATFORMS else None,
        "threads": options.threads,
        "step_fs": options.step,
        "openmm": openmm.Platform.getOpenMMVersion(),
    }
    say(f"== {name}, {system.getNumParticles()} atoms, {options.platform} {precision}; equilibrated: {elapsed()}")
    tolerance = options.tolerance or (1e-5 if precision == "single" and properties else 1e-8)
    runs: dict[str, Run] = {}
    for label, make in integrators(options.step / 1000, state, system, precision == "single", tolerance).items():
        if options.integrator and label not in options.integrator:
            continue
        try:
            run = Run(system, make(), state, context_of)
            run.integrator.step(10)
            run.wait()
            runs[label] = run
            head["device"] = (
                platform.getPropertyValue(run.context, "DeviceName") if options.platform in GPU_PLATFORMS else None
            )
        except openmm.OpenMMException as error:
            say(f"   {label} is left out: {error}")
    say(f"   contexts: {elapsed()}; {head.get('device')}")

    def write(numbers: dict[str, Any]) -> None:
        if options.output:
            with open(options.output, "a") as file:
                print(json.dumps({**head, **numbers}), file=file)

    for steps in options.calls:
        if time.perf_counter() - BEGIN > options.budget:
            say(f"   step({steps}) is left out: the time is up")
            continue
        found = measure_speed(runs, steps, options.seconds, options.rounds)
        for label, seconds in found.items():
            ratios = [b / a for a, b in zip(seconds, found["Verlet"], strict=True)] if "Verlet" in found else []
            numbers = {
                "integrator": label,
                "steps_in_a_call": steps,
                "steps_per_second": 1 / statistics.median(seconds),
                "ratio": statistics.median(ratios) if ratios else None,
                "ratios": ratios,
                "last_step_fs": 1000 * runs[label].integrator.getStepSize()._value,
                "constraint_error": constraint_error(system, runs[label].context),
                **describe(runs[label].integrator),
            }
            write(numbers)
            say(
                f"   step({steps:4d}) {label:15s} {numbers['steps_per_second']:9.1f} steps/s "
                f"{1e6 * statistics.median(seconds):9.1f} us  {numbers['ratio'] or 0:6.3f} of Verlet "
                f"({', '.join(f'{ratio:.3f}' for ratio in ratios)})  last step {numbers['last_step_fs']:.3f} fs, "
                f"constraints {numbers['constraint_error']:.1e} {describe(runs[label].integrator) or ''}"
            )
    say(f"   timed: {elapsed()}")
    if name in options.energy:
        for label, run in runs.items():
            if label in ("LangevinMiddle", "Langevin", "custom") or time.perf_counter() - BEGIN > options.budget:
                continue
            try:
                numbers = measure_energy(run, options.duration, 50)
            except openmm.OpenMMException as error:
                say(f"   {label} failed: {error}")
                continue
            write({"integrator": label, **numbers})
            say(
                f"   energy over {numbers['time']:.2f} ps, {label:15s} scatter {numbers['energy_scatter']:.3f} kJ/mol, "
                f"drift {numbers['energy_drift']:+.3f} kJ/mol/ps"
            )
        say(f"   energies: {elapsed()}")


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--platform", default="CUDA")
    parser.add_argument("--precision", nargs="+", default=["mixed"])
    parser.add_argument("--system", nargs="+", choices=list(SYSTEMS), default=["water6k", "water24k", "villin"])
    parser.add_argument("--integrator", nargs="+", help="only these, by their names in the table")
    parser.add_argument("--data", type=Path, help="a folder with states of water and DHFR")
    parser.add_argument("--step", type=float, default=2.0, help="the nominal step (fs)")
    parser.add_argument("--tolerance", type=float, help="of our constraints")
    parser.add_argument("--calls", type=int, nargs="+", default=[1000, 10, 1], help="what step() is called with")
    parser.add_argument("--seconds", type=float, default=0.5, help="the length of a turn")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--equilibrate", type=int, default=1000, help="steps")
    parser.add_argument("--energy", nargs="*", default=[], help="systems whose energy is looked at as well")
    parser.add_argument("--duration", type=float, default=4.0, help="of that (ps)")
    parser.add_argument("--threads", type=int, help="of the CPU platform")
    parser.add_argument("--budget", type=float, default=1e9, help="start nothing more after so many seconds")
    parser.add_argument("--output", help="a file, to which a JSON line is added for each number")
    options = parser.parse_args()
    for precision in options.precision if options.platform in GPU_PLATFORMS else ["double"]:
        for name in options.system:
            if time.perf_counter() - BEGIN > options.budget:
                say(f"== {name}, {precision}: left out, the time is up")
            else:
                measure(name, precision, options)


if __name__ == "__main__":
    main()
