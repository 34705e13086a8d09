# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Systems of the user's own, from files, in the form in which integrators are compared on them.

>>> from openmmvrattle.compare.inputs import from_xml
>>> mine = from_xml("system.xml", "state.xml")  # doctest: +SKIP

What has no start with velocities gets one: the energy is minimized, and the velocities are those of a short run at a
temperature. Energies are compared, so what changes the energy (barostats, thermostats) is left out of the System.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from .._arguments import array
from ..platforms import make_context, platform_and_properties, platform_names
from ..testsystems import ComparisonSettings, MonitorSettings, StepControl, TestSystem, project_onto_constraints

__all__ = ["CONSTRAINTS", "DEFAULT_FORCE_FIELD", "InputError", "from_pdb", "from_system", "from_xml"]

DEFAULT_FORCE_FIELD = ("amber14-all.xml", "amber14/tip3pfb.xml")
"""Proteins, nucleic acids, lipids, water and ions."""
CONSTRAINTS: dict[str, Any] = {"none": None, "HBonds": app.HBonds, "AllBonds": app.AllBonds, "HAngles": app.HAngles}
"""What can be made rigid in a system from a PDB file, by name."""
MOST_CONSTRAINTS_OF_DENSE_PROJECTION = 600
"""Systems with more constraints are put onto them by OpenMM, which is less exact, but does not need dense matrices."""
_ENERGY_CHANGING = (
    openmm.AndersenThermostat,
    openmm.CMMotionRemover,
    openmm.MonteCarloAnisotropicBarostat,
    openmm.MonteCarloBarostat,
    openmm.MonteCarloFlexibleBarostat,
    openmm.MonteCarloMembraneBarostat,
)


class InputError(ValueError):
    """A file cannot be used; the message says why, and what to do."""


def from_pdb(
    path: str | Path,
    force_field: Sequence[str] = DEFAULT_FORCE_FIELD,
    constraints: str = "HBonds",
    add_hydrogens: bool = False,
    cutoff: float = 0.9,
    temperature: float = 300.0,
    seed: int = 1,
    platform: str = "Reference",
    equilibration: float = 1.0,
) -> TestSystem:
    """A system from a PDB file and a force field, equilibrated for a moment.

    Water is rigid. A file with a periodic box gets particle-mesh Ewald with a switched cutoff, one without a box no
    cutoff.

    Args:
        path: the PDB file.
        force_field: XML files of a force field, as `openmm.app.ForceField` takes them.
        constraints: a name out of `CONSTRAINTS`.
        add_hydrogens: whether to add the hydrogen atoms that the file lacks.
        cutoff: of periodic systems, nm.
        temperature: of the start, K.
        seed: of the velocities at the start.
        platform: the OpenMM platform of the equilibration.
        equilibration: its length, ps.
    """
    path = _existing(path)
    pdb = _read_pdb(path)
    try:
        field = app.ForceField(*force_field)
    except Exception as error:
        raise InputError(f"the force field {' '.join(force_field)} cannot be read: {_sentence(error)}") from error
    model = app.Modeller(pdb.topology, pdb.positions)
    periodic = pdb.topology.getPeriodicBoxVectors() is not None
    options: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    if periodic:
        options = {"nonbondedMethod": app.PME, "nonbondedCutoff": cutoff, "switchDistance": 0.9 * cutoff}
    try:
        if add_hydrogens:
            model.addHydrogens(field, platform=platform_and_properties(_for_starts(platform))[0])
        model.addExtraParticles(field)
        system = field.createSystem(
            model.topology, constraints=CONSTRAINTS[constraints], rigidWater=True, removeCMMotion=False, **options
        )
    except Exception as error:
        raise InputError(
            f"the force field {' '.join(force_field)} does not fit {path}: {_sentence(error)} (Is the molecule "
            "complete? --add-hydrogens adds missing hydrogen atoms, --forcefield names other force fields.)"
        ) from error
    positions = np.array(model.positions.value_in_unit(unit.nanometer))
    return from_system(
        path.stem,
        system,
        positions,
        topology=model.topology,
        temperature=temperature,
        seed=seed,
        platform=platform,
        minimize=True,
        equilibration=equilibration,
    )


def from_xml(
    system_path: str | Path,
    state_path: str | Path | None = None,
    positions_path: str | Path | None = None,
    temperature: float = 300.0,
    seed: int = 1,
    platform: str = "Reference",
) -> TestSystem:
    """A system from the XML files that OpenMM's XmlSerializer writes.

    Args:
        system_path: a System.
        state_path: a State with positions; its velocities, box and parameters are taken as well, where it has them.
        positions_path: instead of a State, a PDB file with the positions.
        temperature: of the velocities at the start, where the State has none, K.
        seed: of these velocities.
        platform: the OpenMM platform on which the start is put onto the constraints.
    """
    system = _deserialized(system_path, openmm.System, "System")
    path = Path(system_path)
    velocities, parameters = None, {}
    if state_path is not None:
        state = _deserialized(state_path, openmm.State, "State")
        if not state.getDataTypes() & openmm.State.Positions:
            raise InputError(
                f"the State in {state_path} has no positions; save one with getState(positions=True, ...)."
            )
        positions = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        if state.getDataTypes() & openmm.State.Velocities:
            velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        if state.getDataTypes() & openmm.State.Parameters:
            parameters = dict(state.getParameters())
        if system.usesPeriodicBoundaryConditions():
            system.setDefaultPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    elif positions_path is not None:
        positions = _read_pdb(_existing(positions_path)).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    else:
        raise InputError(f"the System in {path} needs a start: give --state STATE.xml or --pdb POSITIONS.pdb as well.")
    if len(positions) != system.getNumParticles():
        raise InputError(
            f"{state_path or positions_path} has {len(positions)} particles, but the System in {path} has "
            f"{system.getNumParticles()}."
        )
    return from_system(path.stem, system, positions, velocities, temperature, seed, platform, parameters=parameters)


def from_system(
    name: str,
    system: openmm.System,
    positions: Any,
    velocities: Any = None,
    temperature: float = 300.0,
    seed: int = 1,
    platform: str = "Reference",
    topology: app.Topology | None = None,
    parameters: dict[str, float] | None = None,
    minimize: bool = False,
    equilibration: float = 0.0,
    step_size: float = 0.001,
    steps: int = 2000,
) -> TestSystem:
    """A system in memory, in the form in which integrators are compared on it. The System itself is not changed.

    Args:
        name: how it is called in tables and files.
        system: the System.
        positions: nm, or a Quantity.
        velocities: nm/ps, or a Quantity; None for velocities drawn at the temperature.
        temperature: of these velocities, K.
        seed: of these velocities.
        platform: the OpenMM platform on which the start is put onto the constraints.
        topology: the topology, if there is one.
        parameters: values of global parameters.
        minimize: whether to minimize the energy first.
        equilibration: how long to run at the temperature first, ps.
        step_size: the mean step of the comparison, ps.
        steps: the number of steps of the comparison.
    """
    system, notes = _energy_conserving(system)
    positions = array(positions, "positions", unit.nanometer)
    velocities = None if velocities is None else array(velocities, "velocities", unit.nanometer / unit.picosecond)
    monitor = "ConstraintAndAppliedForce" if system.getNumConstraints() else "AppliedForce"
    control = StepControl(monitors=(MonitorSettings(monitor),), nominal_step_size=step_size)
    settings = ComparisonSettings(step_size * steps, steps, (control,))
    description = f"{name}: {system.getNumParticles():,} particles, {system.getNumConstraints():,} constraints"
    start = TestSystem(
        name=name,
        system=system,
        topology=topology or _bare_topology(system.getNumParticles()),
        positions=positions,
        velocities=np.zeros_like(positions),
        description=description,
        settings=settings,
        parameters=tuple((parameters or {}).items()),
        notes=tuple(notes),
    )
    try:
        return _started(start, velocities, temperature, seed, platform, minimize, equilibration)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{name} cannot be started: {_sentence(error)}") from error


def _started(
    start: TestSystem,
    velocities: np.ndarray | None,
    temperature: float,
    seed: int,
    platform: str,
    minimize: bool,
    equilibration: float,
) -> TestSystem:
    """Minimize, draw velocities, equilibrate, and put the result onto the constraints."""
    system = start.system
    integrator = openmm.LangevinMiddleIntegrator(temperature * unit.kelvin, 10.0 / unit.picosecond, 0.001)
    integrator.setRandomNumberSeed(seed)
    integrator.setConstraintTolerance(1e-8)
    context = make_context(system, integrator, _for_starts(platform))
    # Those of Forces that were left out are of no use any more.
    known = set(context.getParameters())
    start = replace(start, parameters=tuple(pair for pair in start.parameters if pair[0] in known))
    for name, value in start.parameters:
        context.setParameter(name, value)
    context.setPositions(start.positions)
    if minimize:
        openmm.LocalEnergyMinimizer.minimize(context, 10.0)
    context.applyConstraints(1e-8)
    if velocities is None:
        context.setVelocitiesToTemperature(temperature * unit.kelvin, seed)
    else:
        context.setVelocities(velocities)
    if equilibration > 0.0:
        integrator.step(round(equilibration / 0.001))
    context.applyVelocityConstraints(1e-10)
    state = context.getState(positions=True, velocities=True, energy=True)
    positions = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
    energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    if not np.isfinite(energy) or not np.all(np.isfinite(velocities)):
        raise InputError(f"the start of {start.name} has no finite energy: do two of its particles coincide?")
    has_virtual_sites = any(system.isVirtualSite(i) for i in range(system.getNumParticles()))
    if system.getNumConstraints() <= MOST_CONSTRAINTS_OF_DENSE_PROJECTION and not has_virtual_sites:
        positions, velocities = project_onto_constraints(system, positions, velocities)
    return replace(start, positions=positions, velocities=velocities)


def _for_starts(platform: str) -> str:
    """Where a start is prepared: not with OpenCL, for under PoCL 3.1, a driver for processors, OpenMM's minimizer
    crashes, and its constraint solver is inexact."""
    return ("CPU" if "CPU" in platform_names() else "Reference") if platform.startswith("OpenCL") else platform


def _energy_conserving(system: openmm.System) -> tuple[openmm.System, list[str]]:
    """A copy without the Forces that change the energy, and what was left out."""
    system = openmm.XmlSerializer.clone(system)
    notes = []
    for index in reversed(range(system.getNumForces())):
        force = system.getForce(index)
        if isinstance(force, _ENERGY_CHANGING):
            notes.append(f"{type(force).__name__} is left out of the System, for it changes the energy.")
            system.removeForce(index)
    return system, notes


def _deserialized(path: str | Path, kind: type, word: str) -> Any:
    path = _existing(path)
    try:
        content = openmm.XmlSerializer.deserialize(path.read_text(encoding="utf-8"))
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as an OpenMM XML file ({_sentence(error)}); XmlSerializer writes them."
        ) from error
    if not isinstance(content, kind):
        raise InputError(f"{path} has a {type(content).__name__}, not a {word}.")
    return content


def _read_pdb(path: Path) -> app.PDBFile:
    try:
        pdb = app.PDBFile(str(path))
    except (AttributeError, IndexError):  # which is how it takes a file without atoms
        pdb = None
    except Exception as error:
        raise InputError(f"{path} cannot be read as a PDB file ({_sentence(error)}).") from error
    if pdb is None or pdb.topology.getNumAtoms() == 0:
        raise InputError(f"{path} has no atoms; is it a PDB file?")
    return pdb


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give a file.")
    if not path.is_file():
        raise InputError(f"there is no file {path}.")
    return path


def _bare_topology(particles: int) -> app.Topology:
    topology = app.Topology()
    residue = topology.addResidue("UNK", topology.addChain())
    for index in range(particles):
        topology.addAtom(f"X{index + 1}", None, residue)
    return topology


def _sentence(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
