# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""A protein in water at constant energy, with automatic step control and with VerletIntegrator, side by side.

    python benchmarks/proof.py [--system villin] [--platform CPU] [--time 100] [--step 2] [--resume] [--page]

Both integrators start from one state and take turns of a few steps each, so that whatever else the machine does hits
both alike. In the middle each run is stopped, saved as a checkpoint, and goes on in a Context with an integrator that
is made anew. Measured are the wall time, the drift and the fluctuation of the total energy, the largest error of a
constraint, and the energy before and after the restart.

The systems: `villin`, the headpiece of 35 residues in water with 8,867 atoms that comes with OpenMM, and
`alanine-dipeptide` in a box of 2.5 nm. Both have rigid water, rigid bonds to hydrogen, and PME.

A run takes an hour or more. Every half minute it is saved in the folder ``--output``; the same command with
``--resume`` goes on with what is there, for example after the machine was needed for something else.

Prints a table, and writes proof.json, proof.csv with the energies, and proof.png to the folder ``--output``; with
``--page`` it puts table and figure into docs/proof.md as well, where that has a place for the system and the platform.
"""

from __future__ import annotations

import argparse
import base64
import csv
import json
import math
import shutil
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pages
from drift import BLOCKS, BOLTZMANN, TEMPERATURE, fit_drift
from matplotlib.figure import Figure
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import alanine_dipeptide, constraint_error

VERLET, AUTOMATIC = "VerletIntegrator", "automatic"
COLOURS = {VERLET: "#E69F00", AUTOMATIC: "#0072B2"}
TURN = 25
"""Steps that one integrator takes before it is the other's turn, and between two looks at the energy."""
SAVE_EVERY = 30.0
"""Seconds between two savings of an unfinished run."""
SETTLING = 4
"""Turns whose energies are not counted: the thermostat leaves velocities that lie half a step behind the positions, and
that are not quite tangent to the constraints, which is no typical state for a method that has both at one time."""


def villin() -> app.Modeller:
    """The protein, water and ions of the test system that is part of OpenMM."""
    file = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
    return app.Modeller(file.topology, file.positions)


def dipeptide() -> app.Modeller:
    """Alanine dipeptide in a box of water with edges of 2.5 nm."""
    molecule = alanine_dipeptide(constraints=app.HBonds)
    modeller = app.Modeller(molecule.topology, molecule.positions * unit.nanometer)
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    modeller.addSolvent(field, boxSize=openmm.Vec3(2.5, 2.5, 2.5) * unit.nanometer)
    return modeller


SYSTEMS = {"villin": villin, "alanine-dipeptide": dipeptide}


def create_system(topology: app.Topology) -> openmm.System:
    """As for any simulation at constant energy: a switched cutoff, and nothing that changes velocities."""
    system = app.ForceField("amber14-all.xml", "amber14/tip3p.xml").createSystem(
        topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=0.9 * unit.nanometer,
        switchDistance=0.8 * unit.nanometer,
        ewaldErrorTolerance=1e-4,
        constraints=app.HBonds,
        rigidWater=True,
        removeCMMotion=False,
    )
    return system


def make_integrator(name: str, step: float) -> openmm.Integrator:
    """One of the two, with the constraint tolerance that is usual for it.

    Args:
        name: which.
        step: its step in ps.
    """
    if name == AUTOMATIC:
        return VariableStepRattleIntegrator(step, automatic=True)
    integrator = openmm.VerletIntegrator(step)
    integrator.setConstraintTolerance(1e-6)
    return integrator


@dataclass
class Run:
    """One integrator, and what was seen of it."""

    name: str
    times: list[float] = field(default_factory=list)
    """ps"""
    energies: list[float] = field(default_factory=list)
    """kJ/mol"""
    seconds: list[float] = field(default_factory=list)
    """of each turn"""
    steps: list[float] = field(default_factory=list)
    """sizes of the last step of each turn in ps"""
    evaluations: int = 0
    constraint_error: float = 0.0
    energy_change_at_restart: float = math.nan
    """kJ/mol"""


@dataclass(frozen=True)
class Summary:
    """The numbers of one run."""

    integrator: str
    simulated_ps: float
    steps: int
    force_evaluations: int
    wall_seconds: float
    ns_per_day: float
    cost: float
    """of a turn beside the turn of VerletIntegrator next to it: the median"""
    drift: float
    """kJ/mol/ns"""
    drift_error: float
    drift_per_freedom: float
    """kT for each degree of freedom and ns"""
    fluctuation: float
    """standard deviation of the energy about the line of the drift, kJ/mol"""
    constraint_error: float
    energy_change_at_restart: float
    smallest_step_fs: float
    largest_step_fs: float


class Problem:
    """A System in equilibrium and the platform on which it runs."""

    def __init__(
        self, name: str, platform: str, relaxation: float, threads: int | None = None, start: openmm.State | None = None
    ) -> None:
        """
        Args:
            name: of the system.
            platform: of OpenMM.
            relaxation: how long it is relaxed at constant temperature, in ps.
            threads: of the platform CPU; its own choice by default.
            start: of a run that was begun before, which needs no relaxation.
        """
        modeller = SYSTEMS[name]()
        self.name = name
        self.topology = modeller.topology
        self.system = create_system(modeller.topology)
        self.platform = openmm.Platform.getPlatformByName(platform)
        # Single precision drifts by itself at constant energy.
        self.properties = {"Precision": "mixed"} if "Precision" in self.platform.getPropertyNames() else {}
        if threads is not None and "Threads" in self.platform.getPropertyNames():
            self.properties["Threads"] = str(threads)
        integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, 5.0, 0.002)
        integrator.setRandomNumberSeed(1)
        context = openmm.Context(self.system, integrator, self.platform, self.properties)
        if start is None:
            context.setPositions(modeller.positions)
            openmm.LocalEnergyMinimizer.minimize(context, 10.0, 200)
            context.setVelocitiesToTemperature(TEMPERATURE, 2)
            integrator.step(round(relaxation / 0.002))
            start = context.getState(positions=True, velocities=True)
        self.start = start
        self.device = None
        if "DeviceName" in self.platform.getPropertyNames():
            self.device = self.platform.getPropertyValue(context, "DeviceName")

    @property
    def atoms(self) -> int:
        return self.system.getNumParticles()

    @property
    def degrees_of_freedom(self) -> int:
        massive = sum(self.system.getParticleMass(i)._value > 0 for i in range(self.atoms))
        return 3 * massive - self.system.getNumConstraints()

    def context(self, integrator: openmm.Integrator) -> openmm.Context:
        """A Context at the start."""
        context = openmm.Context(self.system, integrator, self.platform, self.properties)
        context.setPeriodicBoxVectors(*self.start.getPeriodicBoxVectors())
        context.setPositions(self.start.getPositions())
        context.setVelocities(self.start.getVelocities())
        return context


def energy_of(context: openmm.Context) -> float:
    """The total energy in kJ/mol."""
    state = context.getState(energy=True)
    return state.getPotentialEnergy()._value + state.getKineticEnergy()._value


def restart(problem: Problem, run: Run, context: openmm.Context, step: float) -> openmm.Context:
    """Save a run and go on with it in a Context that is made anew."""
    checkpoint, before = context.createCheckpoint(), energy_of(context)
    again = problem.context(make_integrator(run.name, step))
    again.loadCheckpoint(checkpoint)
    run.energy_change_at_restart = energy_of(again) - before
    return again


class Unfinished:
    """The file that an unfinished run goes on from."""

    def __init__(self, path: Path, settings: dict[str, object]) -> None:
        """
        Args:
            path: of the file.
            settings: of the run; one with others must not be mixed with it.
        """
        self.path, self.settings = path, settings
        self.saved: dict[str, Any] | None = None

    def load(self) -> None:
        """Take what was saved.

        Raises:
            ValueError: if that was a run with other settings.
        """
        self.saved = json.loads(self.path.read_text(encoding="utf-8"))
        if self.saved["settings"] != self.settings:
            raise ValueError(f"{self.path} is of a run with other settings: {self.saved['settings']}.")

    def start(self) -> openmm.State | None:
        """Where both runs began, if something was loaded."""
        return openmm.XmlSerializer.deserialize(self.saved["start"]) if self.saved else None

    def save(self, turn: int, problem: Problem, runs: Sequence[Run], contexts: dict[str, openmm.Context]) -> None:
        """Save everything that was computed before a turn."""
        saved = {
            "settings": self.settings,
            "start": openmm.XmlSerializer.serialize(problem.start),
            "turn": turn,
            "runs": [asdict(run) for run in runs],
            "checkpoints": {
                name: base64.b64encode(context.createCheckpoint()).decode() for name, context in contexts.items()
            },
        }
        new = self.path.with_suffix(".new")
        new.write_text(json.dumps(saved), encoding="utf-8")
        new.replace(self.path)  # never half a file


def simulate(problem: Problem, total_time: float, step: float, unfinished: Unfinished) -> list[Run]:
    """Both integrators in turns, to the same time.

    Args:
        problem: what to simulate.
        total_time: in ps.
        step: the nominal one of both, in ps.
        unfinished: what it goes on from, and where it is saved.
    """
    runs, first = [Run(VERLET), Run(AUTOMATIC)], 0
    contexts = {run.name: problem.context(make_integrator(run.name, step)) for run in runs}
    if unfinished.saved:
        runs, first = [Run(**run) for run in unfinished.saved["runs"]], unfinished.saved["turn"]
        for name, checkpoint in unfinished.saved["checkpoints"].items():
            contexts[name].loadCheckpoint(base64.b64decode(checkpoint))
    else:
        for run in runs:
            contexts[run.name].getIntegrator().step(1)  # what is prepared once is not the cost of a turn
            run.times.append(contexts[run.name].getTime()._value)
            run.energies.append(energy_of(contexts[run.name]))
    turns = round(total_time / step / TURN)
    saved = time.monotonic()
    for turn in range(first, turns):
        for run in runs if turn % 2 else reversed(runs):
            if turn == turns // 2:
                contexts[run.name] = restart(problem, run, contexts[run.name], step)
            context = contexts[run.name]
            integrator = context.getIntegrator()
            begin = time.perf_counter()
            integrator.step(TURN)
            state = context.getState(positions=True)  # waits for a device
            run.seconds.append(time.perf_counter() - begin)
            run.times.append(state.getTime()._value)
            run.energies.append(energy_of(context))
            run.steps.append(integrator.getStepSize()._value)
            if turn % 20 == 0 or turn in (turns // 2, turns - 1):
                error = constraint_error(problem.system, state.getPositions(asNumpy=True)._value)
                run.constraint_error = max(run.constraint_error, error)
        if time.monotonic() > saved + SAVE_EVERY:
            unfinished.save(turn + 1, problem, runs, contexts)
            saved = time.monotonic()
            print(f"{runs[0].times[-1]:.1f} of {total_time:g} ps", file=sys.stderr, flush=True)
    for run in runs:
        run.evaluations = len(run.seconds) * TURN  # one a step; ours counts, since its last restart
    return runs


def summarize(problem: Problem, runs: Sequence[Run]) -> list[Summary]:
    """The numbers of all runs; the first is that of VerletIntegrator."""
    summaries = []
    for run in runs:
        times, energies = np.array(run.times[SETTLING:]), np.array(run.energies[SETTLING:])
        slope, error, _ = fit_drift(times, energies)
        line = np.polyfit(times, energies, 1)
        wall = sum(run.seconds)
        summaries.append(
            Summary(
                integrator=run.name,
                simulated_ps=run.times[-1],
                steps=len(run.seconds) * TURN,
                force_evaluations=run.evaluations,
                wall_seconds=wall,
                ns_per_day=run.times[-1] / 1000 / wall * 86400,
                cost=statistics.median(a / b for a, b in zip(run.seconds, runs[0].seconds, strict=True)),
                drift=1000 * slope,
                drift_error=1000 * error,
                drift_per_freedom=1000 * slope / (BOLTZMANN * TEMPERATURE * problem.degrees_of_freedom),
                fluctuation=float(np.std(energies - np.polyval(line, times))),
                constraint_error=run.constraint_error,
                energy_change_at_restart=run.energy_change_at_restart,
                smallest_step_fs=1000 * min(run.steps),
                largest_step_fs=1000 * max(run.steps),
            )
        )
    return summaries


def table(summaries: Sequence[Summary]) -> list[str]:
    """The numbers as Markdown, one column for each integrator."""
    rows = [
        ("simulated time", lambda s: f"{s.simulated_ps:.2f} ps"),
        ("steps", lambda s: f"{s.steps:,}"),
        ("wall time, both in turns", lambda s: f"{s.wall_seconds:.0f} s"),
        ("time of a turn beside VerletIntegrator's, median", lambda s: f"{s.cost:.3f}"),
        ("drift of the total energy", lambda s: f"{s.drift:.0f} ± {s.drift_error:.0f} kJ/mol/ns"),
        ("the same for each degree of freedom", lambda s: f"{s.drift_per_freedom:.1e} kT/ns"),
        ("fluctuation of the total energy", lambda s: f"{s.fluctuation:.1f} kJ/mol"),
        ("largest relative error of a constraint", lambda s: f"{s.constraint_error:.1e}"),
        ("change of the energy by the restart", lambda s: f"{s.energy_change_at_restart:.1e} kJ/mol"),
        ("steps from, to", lambda s: f"{s.smallest_step_fs:.3f} fs, {s.largest_step_fs:.3f} fs"),
    ]
    lines = ["| | " + " | ".join(s.integrator for s in summaries) + " |", "|---" * (len(summaries) + 1) + "|"]
    return lines + [f"| {name} | " + " | ".join(value(s) for s in summaries) + " |" for name, value in rows]


def draw(problem: Problem, runs: Sequence[Run]) -> Figure:
    """The total energy against time; a line where the runs were stopped and went on."""
    figure = Figure(figsize=(9.0, 3.8), dpi=100, layout="constrained")
    axes = figure.subplots()
    for run in runs:
        times, energies = np.array(run.times[SETTLING:]), np.array(run.energies[SETTLING:])
        energies -= np.mean(energies)
        axes.plot(times, energies, color=COLOURS[run.name], linewidth=0.5, alpha=0.5)
        size = max(1, len(energies) // 100)
        count = len(energies) // size
        means = [values[: count * size].reshape(count, size).mean(axis=1) for values in (times, energies)]
        axes.plot(*means, color=COLOURS[run.name], linewidth=2.0, label=run.name)
    axes.axvline(runs[0].times[len(runs[0].times) // 2], color="#555555", linestyle=":", label="restart")
    axes.set_xlabel("time (ps)")
    axes.set_ylabel("total energy - mean (kJ/mol)")
    axes.set_title(f"{problem.name} in water, {problem.atoms:,} atoms, platform {problem.platform.getName()}")
    axes.set_xlim(0, max(run.times[-1] for run in runs))
    axes.grid(True, color="#dddddd", linewidth=0.6)
    axes.legend(ncols=3)
    return figure


def write_csv(runs: Sequence[Run], path: Path) -> None:
    """Times and energies of all runs."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["integrator", "time (ps)", "energy (kJ/mol)"])
        for run in runs:
            writer.writerows((run.name, f"{t:.6f}", f"{e:.6f}") for t, e in zip(run.times, run.energies, strict=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--system", choices=SYSTEMS, default="villin")
    parser.add_argument("--platform", default="CPU")
    parser.add_argument("--threads", type=int, help="of the platform CPU")
    parser.add_argument("--time", type=float, default=100.0, help="of each run, in ps")
    parser.add_argument("--step", type=float, default=2.0, help="the nominal one of both integrators, in fs")
    parser.add_argument("--relaxation", type=float, default=5.0, help="at constant temperature beforehand, in ps")
    parser.add_argument("--output", type=Path, default=Path("out/proof"), metavar="FOLDER")
    parser.add_argument("--resume", action="store_true", help="go on with the unfinished run in the folder --output")
    parser.add_argument("--page", action="store_true", help="put table and figure into docs/proof.md")
    options = parser.parse_args(arguments)
    if options.time * 1000 / options.step < 2 * BLOCKS * TURN:
        parser.error(f"a drift needs at least {2 * BLOCKS * TURN} steps")
    options.output.mkdir(parents=True, exist_ok=True)
    settings = {
        name: getattr(options, name) for name in ("system", "platform", "threads", "time", "step", "relaxation")
    }
    unfinished = Unfinished(options.output / "unfinished.json", settings)
    if options.resume and unfinished.path.exists():
        try:
            unfinished.load()
        except ValueError as error:
            parser.error(str(error))
    problem = Problem(options.system, options.platform, options.relaxation, options.threads, unfinished.start())
    runs = simulate(problem, options.time, options.step / 1000, unfinished)
    summaries = summarize(problem, runs)
    lines = [
        pages.provenance(problem.device),
        "",
        f"{problem.name}: {problem.atoms:,} atoms, {problem.system.getNumConstraints():,} constraints, platform "
        f"{options.platform}{', mixed precision' if 'Precision' in problem.properties else ''}"
        f"{f', {options.threads} thread(s)' if options.threads else ''}, nominal step {options.step:g} fs.",
        "",
        *table(summaries),
    ]
    print("\n".join(lines))
    (options.output / "proof.json").write_text(json.dumps([asdict(s) for s in summaries], indent=2), encoding="utf-8")
    write_csv(runs, options.output / "proof.csv")
    draw(problem, runs).savefig(options.output / "proof.png")
    unfinished.path.unlink(missing_ok=True)
    if options.page:
        # The platform CPU is the one that everybody has.
        name = "-".join(["proof", options.system] + [options.platform.lower()] * (options.platform != "CPU"))
        shutil.copy(options.output / "proof.png", pages.DOCS / "images" / f"{name}.png")
        pages.write(pages.DOCS / "proof.md", name, [*lines, "", f"![Total energy of both runs](images/{name}.png)"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
