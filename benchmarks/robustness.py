# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Which Langevin integrator survives a bad start, or a step that is too large for one bad moment.

    python benchmarks/robustness.py [--rows NAME ...] [--starts N] [--list] [--output FOLDER]

Each row is a system, a step and a time, run from several starts with four integrators. Each is long enough for the heat
of the start to leave through the friction, so a run has survived if it reaches its end, and its last quarter has the
temperature of the bath. Prints a table, adds the runs to robustness.jsonl.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit
from openmmvrattle import VariableStepRattleLangevinIntegrator
from openmmvrattle.testsystems import alanine_dipeptide, water_clash

KT = 0.00831446261815324
LARGEST_ERROR = 0.25
"""The fraction by which the temperature of the last quarter of a run may be off, beside noise."""


@dataclass(frozen=True)
class Row:
    """A system and how it is run. make(start) returns the System, positions, and velocities or None for 300 K."""

    make: Callable[[int], tuple[openmm.System, np.ndarray, np.ndarray | None]]
    step: float
    """ps"""
    time: float
    """ps"""
    friction: float = 10.0
    temperature: float = 300.0
    platform: str = "Reference"


@dataclass(frozen=True)
class Outcome:
    """What has come of a run."""

    row: str
    integrator: str
    start: int
    survived: bool
    reason: str
    temperature: float
    """Of the last quarter, K."""
    peak: float
    """K"""
    evaluations: float
    """A step."""
    seconds: float


def waters_pushed_together(factor: float) -> Callable[[int], tuple[openmm.System, np.ndarray, np.ndarray | None]]:
    """Eight waters, of which the two that water_clash has at half a diameter are brought to another fraction."""

    def make(start: int) -> tuple[openmm.System, np.ndarray, np.ndarray]:
        clash = water_clash()
        positions = np.array(clash.positions)
        oxygens = np.arange(0, len(positions), 3)
        distances = np.linalg.norm(positions[oxygens][:, None] - positions[oxygens][None], axis=2)
        distances[np.diag_indices(len(oxygens))] = np.inf
        i, j = np.unravel_index(np.argmin(distances), distances.shape)
        direction = positions[3 * j] - positions[3 * i]
        direction /= np.linalg.norm(direction)
        positions[3 * j : 3 * j + 3] += (factor * 0.315061 - distances[i, j]) * direction
        return clash.system, positions, np.array(clash.velocities)

    return make


def solvated_peptide(step_of_hydrogen: float | None = None) -> Callable[[int], tuple[openmm.System, np.ndarray, None]]:
    """Alanine dipeptide in water as it comes from Modeller, at rest."""

    def make(start: int) -> tuple[openmm.System, np.ndarray, np.ndarray]:
        peptide = alanine_dipeptide()
        force_field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
        modeller = app.Modeller(peptide.topology, peptide.positions * unit.nanometer)
        modeller.addSolvent(force_field, padding=0.8 * unit.nanometer)
        system = force_field.createSystem(
            modeller.topology,
            nonbondedMethod=app.PME,
            nonbondedCutoff=0.8 * unit.nanometer,
            constraints=app.HBonds,
            hydrogenMass=step_of_hydrogen,
        )
        positions = np.array(modeller.positions.value_in_unit(unit.nanometer))
        return system, positions, np.zeros_like(positions)

    return make


def vacuum_peptide(start: int) -> tuple[openmm.System, np.ndarray, None]:
    """Alanine dipeptide with HBonds and no mass repartitioning."""
    peptide = alanine_dipeptide()
    return peptide.system, np.array(peptide.positions), None


def nitrogen_gas(start: int) -> tuple[openmm.System, np.ndarray, None]:
    """64 molecules of N2, bonds rigid."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.9)
    positions = []
    for k in np.ndindex(4, 4, 4):
        for end in (0.0, 0.1098):
            system.addParticle(14.0)
            force.addParticle(0, 0.331, 0.3)
            positions.append(0.5 * np.array(k) + [end, 0, 0])
        i = system.getNumParticles() - 2
        system.addConstraint(i, i + 1, 0.1098)
        force.addException(i, i + 1, 0, 1, 0)
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors([2, 0, 0], [0, 2, 0], [0, 0, 2])
    return system, np.array(positions), None


def villin(constraints: object) -> Callable[[int], tuple[openmm.System, np.ndarray, None]]:
    """The protein of OpenMM's test.pdb, 596 atoms in implicit solvent, with hydrogens of 4 amu; minimised a little."""

    def make(start: int) -> tuple[openmm.System, np.ndarray, None]:
        pdb = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
        modeller = app.Modeller(pdb.topology, pdb.positions)
        modeller.delete([r for r in modeller.topology.residues() if r.name in ("HOH", "Cl", "CL", "NA")])
        force_field = app.ForceField("amber14-all.xml", "implicit/obc2.xml")
        system = force_field.createSystem(modeller.topology, constraints=constraints, hydrogenMass=4 * unit.amu)
        plain = force_field.createSystem(modeller.topology)
        context = openmm.Context(plain, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("CPU"))
        context.setPositions(modeller.positions)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 200)
        return system, context.getState(positions=True).getPositions(asNumpy=True)._value, None

    return make


def chain_on_a_wall(speed: float) -> Callable[[int], tuple[openmm.System, np.ndarray, np.ndarray]]:
    """A chain of nine atoms, heavy and light by turns (127 : 1), thrown at a repulsive wall at `speed` km/s."""

    def make(start: int) -> tuple[openmm.System, np.ndarray, np.ndarray]:
        random = np.random.default_rng(start)
        system = openmm.System()
        wall = openmm.CustomExternalForce("4*2*(0.3/x)^12")
        positions = [np.array([1.0, 0.0, 0.0])]
        for i in range(9):
            system.addParticle(127.0 if i % 2 == 0 else 1.0)
            wall.addParticle(i, [])
            if i > 0:
                direction = np.array([0.2, 1.0, 0.0]) + 0.4 * random.normal(size=3)
                positions.append(positions[-1] + 0.16 * direction / np.linalg.norm(direction))
                system.addConstraint(i - 1, i, 0.16)
        system.addForce(wall)
        q = np.array(positions)
        q[:, 0] += 1.0 - q[:, 0].min()
        return system, q, np.tile([-speed, 0.0, 0.0], (9, 1))

    return make


def argon_with_an_intruder(start: int) -> tuple[openmm.System, np.ndarray, None]:
    """64 atoms of argon in a box, one of which sits at 0.4 of the diameter from another."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.7)
    positions = [0.4 * np.array(k) for k in np.ndindex(4, 4, 4)]
    positions[1] = positions[0] + [0.4 * 0.3405, 0, 0]
    for _ in positions:
        system.addParticle(39.948)
        force.addParticle(0, 0.3405, 0.9978)
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors([1.6, 0, 0], [0, 1.6, 0], [0, 0, 1.6])
    return system, np.array(positions), None


def four_site_water(start: int) -> tuple[openmm.System, np.ndarray, None]:
    """216 molecules of TIP4P-Ew as addSolvent() leaves them."""
    force_field = app.ForceField("tip4pew.xml")
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(force_field, model="tip4pew", numAdded=216)
    system = force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.8)
    return system, np.array(modeller.positions.value_in_unit(unit.nanometer)), None


def peptides_on_top_of_each_other(start: int) -> tuple[openmm.System, np.ndarray, None]:
    """Two alanine dipeptides in vacuum, 0.15 nm apart, with HBonds."""
    peptide = alanine_dipeptide()
    modeller = app.Modeller(peptide.topology, peptide.positions * unit.nanometer)
    shift = np.random.default_rng(start).normal(size=3)
    modeller.add(peptide.topology, (peptide.positions + 0.15 * shift / np.linalg.norm(shift)) * unit.nanometer)
    system = app.ForceField("amber14-all.xml").createSystem(modeller.topology, constraints=app.HBonds)
    return system, np.array(modeller.positions.value_in_unit(unit.nanometer)), None


def ions_thrown_together(start: int) -> tuple[openmm.System, np.ndarray, np.ndarray]:
    """Ten pairs of Na and Cl that start at 5 km/s towards each other."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    positions, velocities = [], []
    for pair in range(10):
        for sign, mass, sigma, epsilon in ((1, 22.99, 0.2439, 0.3658), (-1, 35.45, 0.4478, 0.1489)):
            system.addParticle(mass)
            force.addParticle(sign, sigma, epsilon)
            positions.append([0.3 * sign, 0.01 * pair, 1.5 * pair])
            velocities.append([-5.0 * sign, 0, 0])
    system.addForce(force)
    return system, np.array(positions), np.array(velocities)


def stretched_water(start: int) -> tuple[openmm.System, np.ndarray, None]:
    """64 flexible waters whose bonds have 1.4 of their length."""
    force_field = app.ForceField("tip3p.xml")
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(force_field, numAdded=64)
    system = force_field.createSystem(
        modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.6, rigidWater=False
    )
    positions = np.array(modeller.positions.value_in_unit(unit.nanometer)).reshape(-1, 3, 3)
    positions[:, 1:] += 0.4 * (positions[:, 1:] - positions[:, :1])
    return system, positions.reshape(-1, 3), None


def ROWS() -> dict[str, Row]:
    rows = {}
    for factor in (0.6, 0.5, 0.4, 0.3):
        for step in (0.002, 0.004):
            rows[f"clash {factor}, {1000 * step:g} fs"] = Row(waters_pushed_together(factor), step, 2.0)
    for step in (0.002, 0.004):
        rows[f"peptide from Modeller, {1000 * step:g} fs"] = Row(solvated_peptide(), step, 1.0, platform="CPU")
    for step in (0.004, 0.005):
        rows[f"alanine dipeptide, HBonds, {1000 * step:g} fs"] = Row(vacuum_peptide, step, 20.0)
    rows["N2 at 2000 K, 4 fs"] = Row(nitrogen_gas, 0.004, 4.0, temperature=2000)
    rows["villin, AllBonds, HMR, 4 fs"] = Row(villin(app.AllBonds), 0.004, 1.0, platform="CPU")
    rows["villin, HAngles, HMR, 4 fs"] = Row(villin(app.HAngles), 0.004, 1.0, platform="CPU")
    for speed in (10, 30, 60):
        rows[f"chain on a wall, {speed} km/s, 4 fs"] = Row(chain_on_a_wall(speed), 0.004, 3.0)
    # These five were named when the method was finished.
    rows["unseen: argon with an intruder, 10 fs"] = Row(argon_with_an_intruder, 0.010, 5.0, temperature=120)
    rows["unseen: TIP4P-Ew from addSolvent, 4 fs"] = Row(four_site_water, 0.004, 1.0, platform="CPU")
    rows["unseen: two peptides on top of each other, 2 fs"] = Row(peptides_on_top_of_each_other, 0.002, 2.0)
    rows["unseen: ions thrown together, 4 fs"] = Row(ions_thrown_together, 0.004, 2.0)
    rows["unseen: stretched flexible water, 1 fs"] = Row(stretched_water, 0.001, 1.0, platform="CPU")
    return rows


def make_integrators(row: Row, seed: int) -> dict[str, openmm.Integrator]:
    t, gamma, h = row.temperature, row.friction, row.step
    result = {
        "ours": VariableStepRattleLangevinIntegrator(t, gamma, h),
        "LangevinMiddle": openmm.LangevinMiddleIntegrator(t, gamma, h),
        "Langevin": openmm.LangevinIntegrator(t, gamma, h),
        "VariableLangevin": openmm.VariableLangevinIntegrator(t, gamma, 1e-4),
    }
    for each in result.values():
        each.setRandomNumberSeed(seed)
    return result


def run(name: str, row: Row, label: str, start: int) -> Outcome:
    """One run with one integrator."""
    system, positions, velocities = row.make(start)
    integrator = make_integrators(row, start)[label]
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(row.platform))
    context.setPositions(positions)
    if velocities is None and label == "ours":
        # OpenMM's solver does not always find velocities along strongly coupled constraints.
        integrator.setVelocitiesToTemperature(row.temperature, start)
    elif velocities is None:
        context.setVelocitiesToTemperature(row.temperature, start)
    else:
        context.setVelocities(velocities)
    moving = sum(system.getParticleMass(i)._value > 0 for i in range(system.getNumParticles()))
    degrees = 3 * moving - system.getNumConstraints()
    pieces = 100
    temperatures: list[float] = []
    reason, began = "", time.perf_counter()
    try:
        for _ in range(pieces):
            if label == "VariableLangevin":
                integrator.stepTo(context.getTime()._value + row.time / pieces)
            else:
                integrator.step(max(1, round(row.time / row.step / pieces)))
            state = context.getState(energy=True)
            kinetic = state.getKineticEnergy()._value
            if not math.isfinite(kinetic + state.getPotentialEnergy()._value):
                reason = "the energy is no number"
                break
            temperatures.append(2 * kinetic / (degrees * KT))
    except openmm.OpenMMException as error:
        reason = str(error).splitlines()[0]
    seconds = time.perf_counter() - began
    last = np.array(temperatures[-pieces // 4 :]) if len(temperatures) == pieces else np.array([math.nan])
    mean = float(np.mean(last))
    # The kinetic energy of few particles fluctuates: by sqrt(2/degrees) at a time, of which some are independent.
    noise = 4 * math.sqrt(2 / degrees / 6)
    survived = not reason and abs(mean / row.temperature - 1) < LARGEST_ERROR + noise
    if not reason and not survived:
        reason = f"{mean:.0f} K at the end"
    steps = round(row.time / row.step / pieces) * pieces
    evaluations = integrator.getNumForceEvaluations() / steps if label == "ours" else math.nan
    peak = max(temperatures, default=math.nan)
    return Outcome(name, label, start, survived, reason, mean, peak, evaluations, seconds)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    rows = ROWS()
    parser.add_argument("--rows", nargs="+", metavar="NAME", help="what the names of rows begin with. Default: all")
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--integrators", nargs="+", default=["ours", "LangevinMiddle", "Langevin", "VariableLangevin"])
    parser.add_argument("--list", action="store_true", help="print the names of all rows")
    parser.add_argument("--output", type=Path, default=Path("out"))
    options = parser.parse_args(arguments)
    if options.list:
        print("\n".join(rows))
        return 0
    chosen = [n for n in rows if options.rows is None or any(n.startswith(wanted) for wanted in options.rows)]
    options.output.mkdir(parents=True, exist_ok=True)
    print("| row | integrator | survived | evaluations a step | T at the end (K) | peak T (K) | first failure |")
    print("|---|---|---|---|---|---|---|")
    with (options.output / "robustness.jsonl").open("a") as file:
        for name in chosen:
            for label in options.integrators:
                outcomes = [run(name, rows[name], label, start) for start in range(1, options.starts + 1)]
                for outcome in outcomes:
                    file.write(json.dumps(asdict(outcome)) + "\n")
                good = [o for o in outcomes if o.survived]
                bad = [o.reason for o in outcomes if not o.survived]
                print(
                    f"| {name} | {label} | {len(good)}/{len(outcomes)} "
                    f"| {np.mean([o.evaluations for o in outcomes]):.3g} "
                    f"| {np.mean([o.temperature for o in good]) if good else math.nan:.0f} "
                    f"| {np.max([o.peak for o in outcomes]):.3g} | {bad[0][:80] if bad else ''} |",
                    flush=True,
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
