# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Automatic step control on systems that were not looked at while it was made, and on gases and cold starts.

    python benchmarks/automatic_unseen.py [--systems NAME ...] [--quick] [--output FOLDER]

Each system is run with automatic step control and with fixed steps of the same nominal size, as somebody would who has
switched it on blindly. What counts is the pace (steps of the fixed run over those of the automatic one, over the whole
time and over its last quarter) and, at constant energy, the largest energy error of both. Prints a table, writes
automatic_unseen.jsonl.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import openmm
import pages
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import alanine_dipeptide, rigid_waters, water_clash

MOST_PACE_LOST = 60  # a run that takes this many times the steps of the fixed one is given up
ARGON = (0.3405, 0.9978)  # diameter (nm) and depth (kJ/mol)


@dataclass
class Start:
    """A system and how it is run."""

    system: openmm.System
    positions: np.ndarray
    velocities: np.ndarray
    step: float
    """The nominal step, ps."""
    time: float
    """ps"""
    is_conservative: bool = True
    act: Callable[[openmm.Context, int], None] | None = None
    """What the user does before each piece of the run, given its number."""
    pieces: int = 400
    box: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What has come of one run."""

    steps: int
    time: float
    error: float
    last_pace: float
    """Time over steps, in nominal steps, in the last quarter."""
    smallest_step: float
    warned: bool
    failure: str = ""


@dataclass(frozen=True)
class Result:
    """Both runs of one system."""

    system: str
    nominal_step: float
    automatic: Outcome
    fixed: Outcome
    fixed_with_as_many: Outcome | None = field(default=None)


# ----------------------------------------------------------------------------------------------------- the systems


def maxwell(system: openmm.System, temperature: float, seed: int) -> np.ndarray:
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    velocities = np.random.default_rng(seed).standard_normal((len(masses), 3))
    velocities *= np.sqrt(0.00831446 * temperature / masses)[:, None]
    return velocities - masses @ velocities / masses.sum()


def minimized(system: openmm.System, positions: np.ndarray) -> np.ndarray:
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 1.0)
    return context.getState(positions=True).getPositions(asNumpy=True)._value


def with_thermostat(system: openmm.System, rate: float) -> openmm.System:
    system = openmm.XmlSerializer.clone(system)
    thermostat = openmm.AndersenThermostat(300, rate)
    thermostat.setRandomNumberSeed(7)
    system.addForce(thermostat)
    return system


def water_box(molecules: int = 64, spacing: float = 0.311) -> tuple[openmm.System, np.ndarray, float]:
    """Rigid waters on a lattice, periodic, with a reaction field."""
    single = rigid_waters(1)
    side = round(molecules ** (1 / 3))
    box = side * spacing
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors([box, 0, 0], [0, box, 0], [0, 0, box])
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.45 * box)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(0.38 * box)
    source = next(f for f in single.system.getForces() if isinstance(f, openmm.NonbondedForce))
    positions = []
    random = np.random.default_rng(2)
    for n in range(molecules):
        corner = spacing * np.array([n % side, n // side % side, n // side**2])
        turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
        for k in range(3):
            system.addParticle(single.system.getParticleMass(k))
            force.addParticle(*source.getParticleParameters(k))
            positions.append(corner + turn @ (single.positions[k] - single.positions[0]))
        for k in range(3):
            i, j, length = single.system.getConstraintParameters(k)
            system.addConstraint(3 * n + i, 3 * n + j, length)
            force.addException(3 * n + i, 3 * n + j, 0, 1, 0)
    system.addForce(force)
    return system, np.array(positions), box


def cold_water() -> Start:
    system, positions, _ = water_box()
    positions = minimized(system, positions)
    return Start(with_thermostat(system, 5), positions, np.zeros_like(positions), 0.002, 4.0, False)


def pressure() -> Start:
    system, positions, _ = water_box()
    system = with_thermostat(system, 5)
    barostat = openmm.MonteCarloBarostat(1.0, 300, 5)
    barostat.setRandomNumberSeed(3)
    system.addForce(barostat)
    return Start(system, positions, np.zeros_like(positions), 0.002, 2.0, False)


def argon_box(atoms: int = 64, spacing: float = 0.45) -> tuple[openmm.System, np.ndarray]:
    side = round(atoms ** (1 / 3))
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors([side * spacing, 0, 0], [0, side * spacing, 0], [0, 0, side * spacing])
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.85)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(0.7)
    positions = []
    for n in range(atoms):
        system.addParticle(39.948)
        force.addParticle(0, *ARGON)
        positions.append(spacing * np.array([n % side, n // side % side, n // side**2]))
    system.addForce(force)
    return system, np.array(positions)


def heated_gas() -> Start:
    system, positions = argon_box()
    cold, hot = maxwell(system, 85, 1), maxwell(system, 3000, 2)

    def act(context: openmm.Context, piece: int) -> None:
        if piece == 100:
            context.setVelocities(hot)

    return Start(system, positions, cold, 0.004, 8.0, act=act)


def sheared_gas() -> Start:
    system, positions = argon_box()
    velocities = maxwell(system, 85, 1)
    velocities[:, 0] += 1.0 * np.sin(2 * np.pi * positions[:, 1] / 1.8)
    return Start(system, positions, velocities, 0.004, 8.0)


def two_species() -> Start:
    system = openmm.System()
    box, atoms = 6.0, 40
    system.setDefaultPeriodicBoxVectors([box, 0, 0], [0, box, 0], [0, 0, box])
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(1.2)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(1.0)
    random = np.random.default_rng(4)
    for n in range(atoms):
        mass, parameters = (4.0026, (0.2551, 0.0849)) if n % 2 else (131.29, (0.396, 1.80))
        system.addParticle(mass)
        force.addParticle(0, *parameters)
    system.addForce(force)
    positions = np.array([[n % 4, n // 4 % 4, n // 16] for n in range(atoms)]) * 1.5 + 0.2 * random.random((atoms, 3))
    return Start(system, positions, maxwell(system, 300, 5), 0.002, 20.0)


def reactive() -> Start:
    system = openmm.System()
    morse = openmm.CustomBondForce("458*(1-exp(-19*(r-0.0741)))^2")
    for _ in range(3):
        system.addParticle(1.008)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        morse.addBond(i, j)
    system.addForce(morse)
    positions = np.array([[-0.6, 0.005, 0], [0.0, 0, 0], [0.0741, 0, 0]])
    return Start(system, positions, np.array([[10.0, 0, 0], [0, 0, 0], [0, 0, 0]]), 0.00025, 0.3)


def peptide_on_wall() -> Start:
    test = alanine_dipeptide()
    system = openmm.XmlSerializer.clone(test.system)
    wall = openmm.CustomExternalForce("(0.25/(x+1.2))^12")
    for i in range(system.getNumParticles()):
        wall.addParticle(i)
    system.addForce(wall)
    centre = test.positions.mean(axis=0)
    return Start(system, test.positions - centre, test.velocities + np.array([-3.0, 0, 0]), 0.001, 1.0)


def clash_at_rest() -> Start:
    test = water_clash()
    return Start(test.system, test.positions, np.zeros_like(test.positions), 0.0005, 0.3)


def comet() -> Start:
    system = openmm.System()
    force = openmm.NonbondedForce()
    for mass, charge in ((1e4, 1.0), (1.0, -1.0)):
        system.addParticle(mass)
        force.addParticle(charge, 1.0, 0.0)
    system.addForce(force)
    far, eccentricity = 1.0, 0.9
    semi_axis = far / (1 + eccentricity)
    speed = math.sqrt(138.935458 * (1 - eccentricity) / far)
    period = 2 * math.pi * math.sqrt(semi_axis**3 / 138.935458)
    return Start(
        system,
        np.array([[0, 0, 0], [far, 0, 0.0]]),
        np.array([[0, -speed / 1e4, 0], [0, speed, 0]]),
        period / 4000,
        5 * period,
    )


def collapse() -> Start:
    beads, length = 24, 0.35
    system = openmm.System()
    force = openmm.NonbondedForce()
    for n in range(beads):
        system.addParticle(50.0)
        force.addParticle(0.5 * (-1) ** (n // 2), 0.3, 1.0)
        if n:
            system.addConstraint(n - 1, n, length)
            force.addException(n - 1, n, 0, 1, 0)
    system.addForce(force)
    zigzag = 0.1 * np.array([[0, n % 2, 0.3 * math.sin(n)] for n in range(beads)])
    positions = [zigzag[0]]
    for n in range(1, beads):
        side = zigzag[n] - zigzag[n - 1]
        positions.append(positions[-1] + side + np.array([math.sqrt(length**2 - side @ side), 0, 0]))
    return Start(system, np.array(positions), np.zeros((beads, 3)), 0.002, 8.0)


def replica_exchange() -> Start:
    test = alanine_dipeptide()

    def act(context: openmm.Context, piece: int) -> None:
        context.setVelocitiesToTemperature((300, 450, 600)[piece % 3], piece + 1)

    return Start(test.system, test.positions, test.velocities, 0.001, 4.0, False, act, pieces=200)


def heating_by_hand() -> Start:
    test = alanine_dipeptide()

    def act(context: openmm.Context, piece: int) -> None:
        if piece == 10:
            context.setVelocities(test.velocities)

    return Start(
        test.system, minimized(test.system, test.positions), np.zeros_like(test.positions), 0.001, 2.0, True, act
    )


def two_in_a_gas(distance: float, are_molecules: bool) -> Start:
    system = openmm.System()
    force = openmm.NonbondedForce()
    positions, velocities = [], []
    for sign in (-1, 1):
        for k in range(2 if are_molecules else 1):
            atom = system.addParticle(14.0 if are_molecules else 39.9)
            force.addParticle(0, 0.33, 0.99)
            positions.append([sign * distance / 2, 0.1 * k + 0.02 * sign, 0])
            velocities.append([-sign * 0.25, 0, 0.0])
        if are_molecules:
            system.addConstraint(atom - 1, atom, 0.1)
            force.addException(atom - 1, atom, 0, 1, 0)
    system.addForce(force)
    return Start(system, np.array(positions), np.array(velocities), 0.004, 2 * distance + 3)


def cold_dipeptide(rate: float, step: float) -> Start:
    test = alanine_dipeptide()
    positions = minimized(test.system, test.positions)
    return Start(with_thermostat(test.system, rate), positions, np.zeros_like(positions), step, 4.0, False)


def cold_spring() -> Start:
    system = openmm.System()
    bond = openmm.HarmonicBondForce()
    for mass in (12.0, 16.0):
        system.addParticle(mass)
    bond.addBond(0, 1, 0.12, 300000.0)
    system.addForce(bond)
    return Start(with_thermostat(system, 1), np.array([[0, 0, 0], [0.12, 0, 0]]), np.zeros((2, 3)), 0.001, 4.0, False)


def ideal_gas() -> Start:
    system = openmm.System()
    for _ in range(10):
        system.addParticle(39.9)
    return Start(system, np.random.default_rng(1).random((10, 3)), maxwell(system, 300, 2), 0.004, 10.0)


SYSTEMS: dict[str, Callable[[], Start]] = {
    "cold water": cold_water,
    "heated gas": heated_gas,
    "sheared gas": sheared_gas,
    "two species": two_species,
    "reactive collision": reactive,
    "peptide against a wall": peptide_on_wall,
    "clash at rest": clash_at_rest,
    "pressure": pressure,
    "comet": comet,
    "collapse": collapse,
    "replica exchange": replica_exchange,
    "heating by hand": heating_by_hand,
}
"""Not looked at before the choice."""
SEEN: dict[str, Callable[[], Start]] = {
    **{
        f"{name}, {distance:g} nm": lambda d=distance, m=are_molecules: two_in_a_gas(d, m)
        for name, are_molecules in (("two Ar", False), ("two N2", True))
        for distance in (1.0, 3.0, 8.0)
    },
    **{
        f"cold dipeptide, {rate:g}/ps, {1e3 * step:g} fs": lambda r=rate, s=step: cold_dipeptide(r, s)
        for rate in (1.0, 20.0)
        for step in (0.001, 0.002)
    },
    "cold spring": cold_spring,
    "ideal gas": ideal_gas,
}
"""Chosen on."""


# ------------------------------------------------------------------------------------------------------- the runs


def energy_of(context: openmm.Context) -> float:
    state = context.getState(energy=True)
    return state.getKineticEnergy()._value + state.getPotentialEnergy()._value


def run(start: Start, is_automatic: bool, step: float, part: float) -> Outcome:
    """To the end, in pieces; the energy is measured from the last time on that the user has done something."""
    integrator = VariableStepRattleIntegrator(step)
    if is_automatic:
        integrator.useAutomaticStepControl()
    else:
        integrator.clearMonitors()
    context = openmm.Context(start.system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(start.positions)
    context.setVelocities(start.velocities)
    end, steps, worst, smallest, origin = part * start.time, 0, 0.0, math.inf, math.nan
    late_steps, late_time = 0, 0.0
    most = MOST_PACE_LOST * end / start.step
    failure = ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            for piece in range(start.pieces):
                if start.act is not None:
                    velocities = context.getState(velocities=True).getVelocities(asNumpy=True)._value.copy()
                    start.act(context, piece)
                    now = context.getState(velocities=True).getVelocities(asNumpy=True)._value
                    if piece == 0 or np.any(now != velocities):
                        origin = math.nan
                if math.isnan(origin):
                    origin = energy_of(context)
                while context.getTime()._value < (piece + 1) * end / start.pieces - 0.5 * step and steps < most:
                    before = context.getTime()._value
                    integrator.step(1)
                    steps += 1
                    size = context.getTime()._value - before
                    smallest = min(smallest, size)
                    worst = max(worst, abs(energy_of(context) - origin))
                    if before > 0.75 * end:
                        late_steps, late_time = late_steps + 1, late_time + size
        except openmm.OpenMMException as error:
            failure = str(error)[:120]
    pace = late_time / late_steps / step if late_steps else math.nan
    if not math.isfinite(worst):
        failure = failure or "the energy is not finite"
    return Outcome(steps, context.getTime()._value, worst, pace, smallest, bool(caught), failure)


def measure(name: str, part: float) -> Result:
    start = {**SYSTEMS, **SEEN}[name]()
    automatic, fixed = (run(start, is_automatic, start.step, part) for is_automatic in (True, False))
    as_many = None
    if start.is_conservative and not automatic.failure:
        as_many = run(start, False, part * start.time / automatic.steps, part)
    return Result(name, start.step, automatic, fixed, as_many)


def table(results: Sequence[Result]) -> list[str]:
    """In Markdown."""

    def error(outcome: Outcome | None) -> str:
        if outcome is None:
            return "–"
        return "failed" if outcome.failure else f"{outcome.error:.2g}"

    lines = [
        "| system | nominal step, fs | steps, fixed | steps, automatic | ratio | pace at the end | smallest step | "
        "error, fixed | error, automatic | error, fixed with as many steps |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in results:
        conservative = r.fixed_with_as_many is not None
        lines.append(
            f"| {r.system} | {1e3 * r.nominal_step:.3g} | {r.fixed.steps:,} | {r.automatic.steps:,} | "
            f"{r.automatic.steps / max(1, r.fixed.steps):.2f} | {r.automatic.last_pace:.3f} | "
            f"{r.automatic.smallest_step / r.nominal_step:.2g} | {error(r.fixed) if conservative else '–'} | "
            f"{error(r.automatic) if conservative else error(r.automatic).replace(f'{r.automatic.error:.2g}', '–')} | "
            f"{error(r.fixed_with_as_many)} |"
        )
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n")[0], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [*SYSTEMS, *SEEN]
    parser.add_argument("--systems", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--quick", action="store_true", help="a twentieth of the time; proves nothing")
    parser.add_argument("--output", type=Path, default=Path("out/automatic_unseen"), metavar="FOLDER")
    parser.add_argument("--page", action="store_true", help="put tables and figures into docs/automatic_benchmark.md")
    options = parser.parse_args(arguments)
    if options.page and (options.quick or options.systems != names):
        parser.error("a page shows a run of everything")
    options.output.mkdir(parents=True, exist_ok=True)
    results = []
    for name in options.systems:
        results.append(measure(name, 0.05 if options.quick else 1.0))
        print(json.dumps(asdict(results[-1])), flush=True)
    (options.output / "automatic_unseen.jsonl").write_text("".join(json.dumps(asdict(r)) + "\n" for r in results))
    print("\n".join(table(results)))
    if options.page:
        for place, some in (("unseen", SYSTEMS), ("seen", SEEN)):
            lines = [pages.provenance(), "", *table([result for result in results if result.system in some])]
            pages.write(pages.DOCS / "automatic_benchmark.md", place, lines)
    return 1 if any(r.automatic.failure for r in results) else 0


if __name__ == "__main__":
    sys.exit(main())
