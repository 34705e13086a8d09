# OpenMM-VRATTLE: the reporters of openmm.app.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import csv
import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import Array, positions_of, time_of, value, velocities_of
from openmm import app, unit
from run_support import BOLTZMANN, FORCE_MONITOR, make_integrator, relax, smooth_cutoff, solvated

WATERS = 60


@pytest.fixture(scope="module")
def start() -> tuple[app.Topology, openmm.System, Array, Array]:
    modeller, force_field = solvated(count=WATERS)
    system = smooth_cutoff(
        force_field.createSystem(modeller.topology, nonbondedMethod=app.CutoffPeriodic, nonbondedCutoff=0.5), 0.4
    )
    return modeller.topology, system, *relax(system, modeller.positions)


def make_simulation(start: tuple[app.Topology, openmm.System, Array, Array], platform: str) -> app.Simulation:
    topology, system, positions, velocities = start
    properties = {"Threads": "1", "DeterministicForces": "true"} if platform == "CPU" else {}
    integrator = make_integrator(0.001, FORCE_MONITOR)
    simulation = app.Simulation(topology, system, integrator, openmm.Platform.getPlatformByName(platform), properties)
    simulation.context.setPositions(positions)
    simulation.context.setVelocities(velocities)
    return simulation


def test_state_data_with_all_columns(start: tuple[Any, Any, Any, Any], platform: str) -> None:
    """Each column says what the Context says; the temperature is that of the degrees of freedom left by constraints."""
    simulation = make_simulation(start, platform)
    output = io.StringIO()
    simulation.reporters.append(
        app.StateDataReporter(
            output,
            5,
            step=True,
            time=True,
            potentialEnergy=True,
            kineticEnergy=True,
            totalEnergy=True,
            temperature=True,
            volume=True,
            density=True,
            progress=True,
            remainingTime=True,
            speed=True,
            elapsedTime=True,
            totalSteps=20,
        )
    )
    simulation.step(5)
    state = simulation.context.getState(energy=True)
    kinetic, potential = value(state.getKineticEnergy()), value(state.getPotentialEnergy())
    v = velocities_of(simulation.context)
    masses = np.array([value(simulation.system.getParticleMass(i)) for i in range(3 * WATERS)])
    simulation.step(15)
    rows = list(csv.reader(io.StringIO(output.getvalue())))
    columns = [name.strip('#" ') for name in rows[0]]
    assert len(rows) == 5 and len(columns) == 12
    first = dict(zip(columns, rows[1], strict=True))
    assert int(first["Step"]) == 5
    assert float(first["Potential Energy (kJ/mole)"]) == pytest.approx(potential, rel=1e-9)
    assert float(first["Kinetic Energy (kJ/mole)"]) == pytest.approx(kinetic, rel=1e-9)
    assert float(first["Total Energy (kJ/mole)"]) == pytest.approx(kinetic + potential, rel=1e-9)
    assert kinetic == pytest.approx(0.5 * np.sum(masses[:, None] * v**2), rel=1e-9)
    # 9 coordinates less 3 constraints a molecule, and OpenMM takes off 3 for its CMMotionRemover.
    freedoms = 6 * WATERS - 3
    assert float(first["Temperature (K)"]) == pytest.approx(2 * kinetic / (freedoms * BOLTZMANN), rel=1e-9)
    # With the constraints counted as freedoms it would be two thirds of that, 200 K.
    assert 240 < float(first["Temperature (K)"]) < 400
    assert float(first["Box Volume (nm^3)"]) == pytest.approx(
        value(simulation.context.getState().getPeriodicBoxVolume()), rel=1e-9
    )
    last = dict(zip(columns, rows[4], strict=True))
    assert float(last["Time (ps)"]) == pytest.approx(time_of(simulation.context), rel=1e-9)
    assert last["Progress (%)"] == "100.0%"
    assert int(last["Step"]) == simulation.currentStep == 20
    # The speed is of simulated time, so of the steps as they were.
    assert float(last["Speed (ns/day)"]) > 0
    assert float(last["Elapsed Time (s)"]) > 0


def test_trajectory_files(start: tuple[Any, Any, Any, Any], platform: str, tmp_path: Path) -> None:
    """DCD, PDB and XTC get the positions of the same moments, and do not disturb the run."""
    runs = []
    for report in (False, True):
        simulation = make_simulation(start, platform)
        frames = []
        if report:
            simulation.reporters += [
                app.DCDReporter(str(tmp_path / "run.dcd"), 4, enforcePeriodicBox=False),
                app.PDBReporter(str(tmp_path / "run.pdb"), 4, enforcePeriodicBox=False),
                app.XTCReporter(str(tmp_path / "run.xtc"), 4, enforcePeriodicBox=False),
                app.CheckpointReporter(str(tmp_path / "run.chk"), 4),
                app.CheckpointReporter(str(tmp_path / "run.xml"), 4, writeState=True),
            ]
        for _ in range(3):
            simulation.step(4)
            frames.append(positions_of(simulation.context))
        runs.append((frames, velocities_of(simulation.context)))
    if platform == "Reference":
        assert np.array_equal(runs[0][0], runs[1][0])
        assert np.array_equal(runs[0][1], runs[1][1])
    frames = runs[1][0]
    simulation.reporters.clear()

    pdb = app.PDBFile(str(tmp_path / "run.pdb"))
    assert pdb.getNumFrames() == 3
    for i, frame in enumerate(frames):
        written = pdb.getPositions(asNumpy=True, frame=i).value_in_unit(unit.nanometer)
        np.testing.assert_allclose(written, frame, rtol=0, atol=0.6e-4)  # Three digits in Angstrom.

    dcd = (tmp_path / "run.dcd").read_bytes()
    assert dcd[4:8] == b"CORD"
    count, first_step, interval = struct.unpack("<3i", dcd[8:20])
    assert (count, interval) == (3, 4) and first_step > 0
    x = np.frombuffer(dcd, dtype="<f4", count=3 * WATERS, offset=len(dcd) - 3 * (12 * WATERS + 8) + 4)
    np.testing.assert_allclose(x / 10, frames[2][:, 0], rtol=0, atol=1e-6)  # Single precision in Angstrom.

    from openmm.app.internal.xtc_utils import read_xtc

    coordinates, _, times, steps = read_xtc(str(tmp_path / "run.xtc").encode())
    assert list(steps) == [4, 8, 12]
    # XTCReporter writes the time as step number times step size, which is right for fixed steps alone.
    assert len(times) == 3
    np.testing.assert_allclose(np.moveaxis(coordinates, 2, 0), frames, rtol=0, atol=0.6e-3)  # Picometres.

    for name, load in (("run.chk", simulation.loadCheckpoint), ("run.xml", simulation.loadState)):
        simulation.step(7)
        load(str(tmp_path / name))
        assert simulation.currentStep == 12
        np.testing.assert_allclose(positions_of(simulation.context), frames[2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(velocities_of(simulation.context), runs[1][1], rtol=0, atol=1e-12)
