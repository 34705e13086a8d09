# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Which Langevin integrator survives a bad start, or a step that is too large for one bad moment.

    python benchmarks/robustness.py [--rows NAME ...] [--starts N] [--list] [--output FOLDER] [--page]

Each row is a system, a step and a time, run from several starts with four integrators, and once as a control: with ours
at an eighth of the step. A run has survived if it reaches its end, and the temperature of its second half is that of
the control. The time is long enough for the heat of the start to leave through the friction. VariableLangevinIntegrator
chooses its steps itself, and is given up after fifty times as many as the others take.

Each run is added to robustness.jsonl when it ends, and one that is there with the same settings is not done again: so
the benchmark can be stopped and started at any time. With ``--page`` the table goes into docs/langevin_benchmark.md.
"""

from __future__ import annotations

import argparse
import copy
import datetime
import functools
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import openmm
import pages
from openmm import app, unit
from openmmvrattle import VariableStepRattleLangevinIntegrator
from openmmvrattle.testsystems import alanine_dipeptide, rigid_waters

KT = 0.00831446261815324
OXYGEN = 0.315061
"""The diameter of an oxygen atom of TIP3P water, nm."""
INTEGRATORS = {
    "ours": "this one",
    "LangevinMiddle": "`LangevinMiddleIntegrator`",
    "Langevin": "`LangevinIntegrator`",
    "VariableLangevin": "`VariableLangevinIntegrator`",
}
LARGEST_ERROR = 0.05
"""The fraction by which the temperature of a run may differ from that of the control, beside noise."""
CONTROL = 8
"""The control has the step divided by this."""
FEWEST_PARTS = 50
"""VariableLangevinIntegrator is given up where its steps are on average less than this part of the others'."""
PIECES = 100
"""After each of which the temperature is read."""

Start = tuple[openmm.System, np.ndarray, "np.ndarray | None"]


@dataclass(frozen=True)
class Row:
    """A system and how it is run. make(start) returns the System, positions, and velocities or None for 300 K."""

    make: Callable[[int], Start]
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
    settings: list[float]
    """The step, the time, friction and temperature."""
    reason: str
    """Why it has not reached its end, or nothing."""
    temperature: float
    """Of the second half, K."""
    error: float
    """What that fluctuates by, K."""
    peak: float
    """K"""
    evaluations: float
    """A step, for ours."""
    seconds: float
    date: str


relaxed_waters = functools.cache(rigid_waters)


def waters_pushed_together(factor: float) -> Callable[[int], Start]:
    """Eight waters, of which two are brought to a fraction of their diameter: others in each start."""

    def make(start: int) -> Start:
        waters = relaxed_waters(8)
        positions = np.array(waters.positions)
        oxygens = positions[::3]
        pairs = [(i, j) for i in range(len(oxygens)) for j in range(i)]
        i, j = sorted(pairs, key=lambda pair: np.linalg.norm(oxygens[pair[0]] - oxygens[pair[1]]))[start - 1]
        direction = oxygens[j] - oxygens[i]
        distance = np.linalg.norm(direction)
        positions[3 * j : 3 * j + 3] += (factor * OXYGEN / distance - 1) * direction
        return waters.system, positions, np.array(waters.velocities)

    return make


@functools.cache
def solvated_peptide(start: int) -> Start:
    """Alanine dipeptide, turned at random, in water as Modeller then places it, at rest."""
    peptide = alanine_dipeptide()
    turn, upper = np.linalg.qr(np.random.default_rng(start).normal(size=(3, 3)))
    turn *= np.sign(np.diag(upper))
    turn[:, 0] *= np.linalg.det(turn)  # no mirror image
    force_field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    modeller = app.Modeller(peptide.topology, np.array(peptide.positions) @ turn * unit.nanometer)
    modeller.addSolvent(force_field, padding=0.8 * unit.nanometer)
    system = force_field.createSystem(
        modeller.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.8 * unit.nanometer, constraints=app.HBonds
    )
    positions = np.array(modeller.positions.value_in_unit(unit.nanometer))
    return system, positions, np.zeros_like(positions)


def vacuum_peptide(start: int) -> Start:
    """Alanine dipeptide with HBonds and no mass repartitioning."""
    peptide = alanine_dipeptide()
    return peptide.system, np.array(peptide.positions), None


def nitrogen_gas(start: int) -> Start:
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


def villin(constraints: object) -> Callable[[int], Start]:
    """The protein of OpenMM's test.pdb, 582 atoms in vacuum, with hydrogens of 4 amu; minimised a little."""

    @functools.cache
    def make_once() -> Start:
        pdb = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
        modeller = app.Modeller(pdb.topology, pdb.positions)
        modeller.delete([r for r in modeller.topology.residues() if r.name in ("HOH", "Cl", "CL", "NA")])
        force_field = app.ForceField("amber14-all.xml")
        system = force_field.createSystem(modeller.topology, constraints=constraints, hydrogenMass=4 * unit.amu)
        plain = force_field.createSystem(modeller.topology)
        context = openmm.Context(plain, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("CPU"))
        context.setPositions(modeller.positions)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 200)
        return system, context.getState(positions=True).getPositions(asNumpy=True)._value, None

    return lambda start: make_once()


def chain_on_a_wall(speed: float) -> Callable[[int], Start]:
    """A chain of nine atoms, heavy and light by turns (127 : 1), thrown at a repulsive wall at `speed` km/s."""

    def make(start: int) -> Start:
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


def argon_with_an_intruder(start: int) -> Start:
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


@functools.cache
def four_site_water(start: int = 0) -> Start:
    """216 molecules of TIP4P-Ew as addSolvent() leaves them."""
    force_field = app.ForceField("tip4pew.xml")
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    modeller.addSolvent(force_field, model="tip4pew", numAdded=216)
    system = force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.8)
    return system, np.array(modeller.positions.value_in_unit(unit.nanometer)), None


def nearest_contact(system: openmm.System, q: np.ndarray, first: Sequence[int], second: Sequence[int]) -> float:
    """The smallest distance of particles of two molecules, in units of the mean of their diameters."""
    force = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    sigma = np.array([force.getParticleParameters(i)[1]._value for i in range(system.getNumParticles())])
    r = np.linalg.norm(q[list(first)][:, None] - q[list(second)], axis=2)
    return float(np.min(2 * r / (sigma[list(first)][:, None] + sigma[list(second)])))


def peptides_on_top_of_each_other(least: float, most: float) -> Callable[[int], Start]:
    """Two alanine dipeptides in vacuum, 0.15 nm apart, with HBonds; the nearest contact lies within these bounds."""

    def make(start: int) -> Start:
        peptide = alanine_dipeptide()
        modeller = app.Modeller(peptide.topology, peptide.positions * unit.nanometer)
        modeller.add(peptide.topology, peptide.positions * unit.nanometer)
        system = app.ForceField("amber14-all.xml").createSystem(modeller.topology, constraints=app.HBonds)
        n = len(peptide.positions)
        found, seed = 0, 0
        while found < start:
            seed += 1
            shift = np.random.default_rng(seed).normal(size=3)
            q = np.array(modeller.positions.value_in_unit(unit.nanometer))
            q[n:] += 0.15 * shift / np.linalg.norm(shift)
            found += least <= nearest_contact(system, q, range(n), range(n, 2 * n)) < most
        return system, q, None

    return make


def ions_thrown_together(start: int) -> Start:
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


def stretched_water(start: int) -> Start:
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


def waters_at_random_places(start: int) -> Start:
    """27 rigid waters in a cube of 1 nm, turned at random, oxygens no nearer than 0.1 nm."""
    random = np.random.default_rng(start)
    one = relaxed_waters(1)
    shape = np.array(one.positions) - one.positions[0]
    system = relaxed_waters(27).system
    oxygens: list[np.ndarray] = []
    while len(oxygens) < 27:
        place = random.uniform(0, 1, 3)
        if all(np.linalg.norm(place - other) > 0.1 for other in oxygens):
            oxygens.append(place)
    turns = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in oxygens]
    return system, np.concatenate([o + shape @ turn for o, turn in zip(oxygens, turns, strict=True)]), None


def random_walk(start: int) -> Start:
    """A polymer of 60 beads, 0.3 nm wide, with rigid bonds that walks at random, no beads nearer than 0.1 nm."""
    random = np.random.default_rng(start)
    system = openmm.System()
    force = openmm.NonbondedForce()
    q: list[np.ndarray] = []
    while len(q) < 60:
        step = random.normal(size=3)
        place = q[-1] + 0.25 * step / np.linalg.norm(step) if q else np.zeros(3)
        if any(np.linalg.norm(place - other) < 0.1 for other in q):
            continue
        q.append(place)
        i = system.addParticle(14.0)
        force.addParticle(0, 0.3, 1.0)
        if i > 0:
            system.addConstraint(i - 1, i, 0.25)
            force.addException(i - 1, i, 0, 1, 0)
    system.addForce(force)
    return system, np.array(q), None


def salt_with_a_wrong_ion(start: int) -> Start:
    """A crystal of 64 ions in which a sodium stands a tenth of a nanometre from a chloride beside its own place."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    force.setCutoffDistance(0.55)
    positions = []
    for k in np.ndindex(4, 4, 4):
        sign, mass, sigma, epsilon = ((1, 22.99, 0.2439, 0.3658), (-1, 35.45, 0.4478, 0.1489))[sum(k) % 2]
        system.addParticle(mass)
        force.addParticle(sign, sigma, epsilon)
        positions.append(0.3 * np.array(k, dtype=float))
    positions[0] = positions[1] - [0, 0, 0.1]
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors([1.2, 0, 0], [0, 1.2, 0], [0, 0, 1.2])
    return system, np.array(positions), None


def methane_in_water(start: int) -> Start:
    """A sphere as large as methane at a random place among 64 waters of a liquid, no oxygen nearer than 0.12 nm."""
    random = np.random.default_rng(start)
    waters = relaxed_waters(64)
    system, positions = copy.deepcopy(waters.system), np.array(waters.positions)
    system.addParticle(16.0)
    next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce)).addParticle(0, 0.373, 1.23)
    place = positions[0]
    while np.min(np.linalg.norm(positions[::3] - place, axis=1)) < 0.12:
        place = random.uniform(-0.35, 0.35, 3)
    return system, np.append(positions, [place], axis=0), None


def squeezed_peptide(start: int) -> Start:
    """Alanine dipeptide in vacuum, all coordinates times 0.8; rigid bonds are then made right."""
    peptide = alanine_dipeptide()
    return peptide.system, 0.8 * np.array(peptide.positions), None


def ROWS() -> dict[str, Row]:
    rows = {}
    for factor in (0.6, 0.5, 0.4, 0.3):
        for step in (0.002, 0.004):
            name = f"two of eight rigid waters at {factor} of their diameter, {1000 * step:g} fs"
            rows[name] = Row(waters_pushed_together(factor), step, 10.0)
    for step in (0.002, 0.004):
        name = f"alanine dipeptide, turned, in water from Modeller, not minimised, at rest, {1000 * step:g} fs"
        rows[name] = Row(solvated_peptide, step, 2.0, platform="CPU")
    for step in (0.004, 0.005):
        name = f"alanine dipeptide in vacuum, HBonds, no mass repartitioning, {1000 * step:g} fs"
        rows[name] = Row(vacuum_peptide, step, 20.0)
    rows["N2 gas at 2,000 K, 4 fs"] = Row(nitrogen_gas, 0.004, 4.0, temperature=2000)
    for name, constraints in (("all bonds rigid", app.AllBonds), ("HAngles", app.HAngles)):
        rows[f"villin in vacuum, {name}, hydrogens of 4 amu, 4 fs"] = Row(
            villin(constraints), 0.004, 1.0, platform="CPU"
        )
    for speed in (10, 30, 60):
        name = f"chain of 127 and 1 amu by turns, thrown at a wall at {speed} km/s, 4 fs"
        rows[name] = Row(chain_on_a_wall(speed), 0.004, 10.0)
    # These were named when the method was finished.
    rows["argon, an atom at 0.4 of the diameter from another, 10 fs"] = Row(
        argon_with_an_intruder, 0.010, 5.0, temperature=120
    )
    rows["TIP4P-Ew from addSolvent, 4 fs"] = Row(four_site_water, 0.004, 1.0, platform="CPU")
    rows["pairs of ions thrown at each other at 10 km/s, 4 fs"] = Row(ions_thrown_together, 0.004, 10.0)
    rows["flexible water with bonds of 1.4 of their length, 1 fs"] = Row(stretched_water, 0.001, 1.0, platform="CPU")
    name = "two dipeptides in each other, nearest atoms at {} of their diameter, 2 fs"
    rows[name.format("0.2 or more")] = Row(peptides_on_top_of_each_other(0.2, math.inf), 0.002, 4.0)
    # These were named later, before they were run for the first time.
    rows["27 rigid waters placed and turned at random, 2 fs"] = Row(waters_at_random_places, 0.002, 4.0)
    rows["polymer with rigid bonds that walks at random, 4 fs"] = Row(random_walk, 0.004, 10.0)
    rows["rock salt, an ion at 0.1 nm from another, 4 fs"] = Row(salt_with_a_wrong_ion, 0.004, 2.0, platform="CPU")
    rows["methane put among 64 waters, 4 fs"] = Row(methane_in_water, 0.004, 2.0, platform="CPU")
    rows["alanine dipeptide squeezed to 0.8 of its size, 2 fs"] = Row(squeezed_peptide, 0.002, 10.0)
    # What is beyond the smallest substeps.
    rows[name.format("0.15 to 0.2")] = Row(peptides_on_top_of_each_other(0.15, 0.2), 0.002, 4.0)
    rows[name.format("less than 0.15")] = Row(peptides_on_top_of_each_other(0, 0.15), 0.002, 4.0)
    return rows


def make_integrator(row: Row, label: str, seed: int) -> openmm.Integrator:
    t, gamma, h = row.temperature, row.friction, row.step
    if label in ("ours", "control"):
        result = VariableStepRattleLangevinIntegrator(t, gamma, h if label == "ours" else h / CONTROL)
    elif label == "VariableLangevin":
        result = openmm.VariableLangevinIntegrator(t, gamma, 1e-4)
    else:
        result = getattr(openmm, f"{label}Integrator")(t, gamma, h)
    result.setRandomNumberSeed(seed)
    return result


def advance(context: openmm.Context, integrator: openmm.Integrator, row: Row, label: str, piece: int) -> str:
    """Go on to the end of a piece of the run; returns what is wrong, or nothing."""
    if label != "VariableLangevin":
        integrator.step(max(1, round(row.time / row.step / PIECES)) * (CONTROL if label == "control" else 1))
        return ""
    while context.getTime()._value < row.time * (piece + 1) / PIECES:
        integrator.step(10)
        if context.getStepCount() > FEWEST_PARTS * row.time / row.step:
            return f"its steps are less than {1000 * row.step / FEWEST_PARTS:.2g} fs"
        if not math.isfinite(context.getState(energy=True).getPotentialEnergy()._value):
            return "the energy is no number"
    return ""


def run(name: str, row: Row, label: str, start: int) -> Outcome:
    """One run with one integrator."""
    system, positions, velocities = row.make(start)
    integrator = make_integrator(row, label, start)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(row.platform))
    context.setPositions(positions)
    context.applyConstraints(1e-8)
    context.computeVirtualSites()
    if velocities is None:
        # OpenMM's solver does not always find velocities along strongly coupled constraints.
        ours = VariableStepRattleLangevinIntegrator(row.temperature, 1, row.step)
        other = openmm.Context(system, ours, openmm.Platform.getPlatform(row.platform))
        other.setPositions(context.getState(positions=True).getPositions())
        ours.setVelocitiesToTemperature(row.temperature, start)
        context.setVelocities(other.getState(velocities=True).getVelocities())
    else:
        context.setVelocities(velocities)
    moving = sum(system.getParticleMass(i)._value > 0 for i in range(system.getNumParticles()))
    degrees = 3 * moving - system.getNumConstraints()
    temperatures: list[float] = []
    reason, began = "", time.perf_counter()
    try:
        for piece in range(PIECES):
            reason = advance(context, integrator, row, label, piece)
            state = context.getState(energy=True)
            kinetic = state.getKineticEnergy()._value
            if not math.isfinite(kinetic + state.getPotentialEnergy()._value):
                reason = "the energy is no number"
            if reason:
                break
            temperatures.append(2 * kinetic / (degrees * KT))
    except openmm.OpenMMException as error:
        reason = str(error).splitlines()[0]
    seconds = time.perf_counter() - began
    mean = float(np.mean(temperatures[PIECES // 2 :])) if not reason else math.nan
    # The kinetic energy fluctuates by sqrt(2/degrees); half the time of the friction later it has forgotten its value.
    error = row.temperature * math.sqrt(2 / degrees / max(1.0, row.friction * row.time / 2))
    steps = max(1, round(row.time / row.step / PIECES)) * PIECES * (CONTROL if label == "control" else 1)
    evaluations = integrator.getNumForceEvaluations() / steps if label in ("ours", "control") else math.nan
    settings = [row.step, row.time, row.friction, row.temperature]
    peak = max(temperatures, default=math.nan)
    today = datetime.date.today().isoformat()
    return Outcome(name, label, start, settings, reason, mean, error, peak, evaluations, seconds, today)


def judge(outcome: Outcome, control: Outcome) -> str:
    """Why a run has not survived, or nothing."""
    largest = LARGEST_ERROR * control.temperature + 4 * math.hypot(outcome.error, control.error)
    if outcome.reason or abs(outcome.temperature - control.temperature) < largest:
        return outcome.reason
    return f"{outcome.temperature:.0f} K at the end, and the control {control.temperature:.0f} K"


class Results:
    """The runs in a file, those of earlier times too."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self.outcomes = [Outcome(**json.loads(line)) for line in lines]

    def get(self, name: str, row: Row, label: str, start: int) -> Outcome:
        """A run, which is made if it is not there."""
        settings = [row.step, row.time, row.friction, row.temperature]
        for each in self.outcomes:
            if (each.row, each.integrator, each.start, each.settings) == (name, label, start, settings):
                return each
        outcome = run(name, row, label, start)
        self.outcomes.append(outcome)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(outcome)) + "\n")
        return outcome


def line_of(name: str, row: Row, labels: Sequence[str], starts: int, results: Results) -> tuple[str, list[str]]:
    """The line of a table, and the first failure of each integrator."""
    control = results.get(name, row, "control", 1)
    cells, failures, evaluations, hot = [], [], "", ""
    dates = {control.date}
    for label in labels:
        outcomes = [results.get(name, row, label, start) for start in range(1, starts + 1)]
        dates |= {outcome.date for outcome in outcomes}
        reasons = [judge(outcome, control) for outcome in outcomes]
        good = [outcome for outcome, reason in zip(outcomes, reasons, strict=True) if not reason]
        cells.append(f"{len(good)}/{starts}")
        failures += [f"{name}, {label}: {reason}" for reason in reasons if reason][:1]
        if label == "ours" and good:
            evaluations = f"{np.mean([o.evaluations for o in good]):.3g}"
            mean, error = np.mean([o.temperature for o in good]), good[0].error / math.sqrt(len(good))
            hot = f"{mean:.0f} ± {error:.0f}"
    limits = "-" if control.reason else f"{control.temperature:.0f} ± {control.error:.0f}"
    measured = " to ".join(sorted({min(dates), max(dates)}))
    return f"| {name} | {' | '.join([*cells, evaluations or '-', hot or '-', limits, measured])} |", failures


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    rows = ROWS()
    parser.add_argument("--rows", nargs="+", metavar="NAME", help="what the names of rows begin with. Default: all")
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--integrators", nargs="+", default=list(INTEGRATORS), choices=list(INTEGRATORS))
    parser.add_argument("--list", action="store_true", help="print the names of all rows")
    parser.add_argument("--output", type=Path, default=Path("out"))
    parser.add_argument("--page", action="store_true", help="put the table into docs/langevin_benchmark.md")
    options = parser.parse_args(arguments)
    if options.list:
        print("\n".join(rows))
        return 0
    chosen = [n for n in rows if options.rows is None or any(n.startswith(wanted) for wanted in options.rows)]
    results = Results(options.output / "robustness.jsonl")
    names = [INTEGRATORS[label] for label in options.integrators]
    lines = [
        f"| start, step | {' | '.join(names)} | evaluations a step | K at the end | control | measured |",
        "|---" * (len(names) + 5) + "|",
    ]
    failures = []
    print("\n".join(lines))
    for name in chosen:
        line, more = line_of(name, rows[name], options.integrators, options.starts, results)
        print(line, flush=True)
        lines.append(line)
        failures += more
    print("\nFirst failures:", *failures, sep="\n  ")
    if options.page:
        pages.write(pages.DOCS / "langevin_benchmark.md", "robustness", [pages.provenance(), "", *lines])
    return 0


if __name__ == "__main__":
    sys.exit(main())
