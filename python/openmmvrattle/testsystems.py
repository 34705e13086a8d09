# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Systems with constraints on which integrators can be compared.

Each function builds one system in code, with a start that meets all constraints, and the settings with which
``python -m openmmvrattle compare`` runs it. Some show where variable steps pay, others where they do not.

>>> from openmmvrattle.testsystems import SYSTEMS
>>> pendulum = SYSTEMS["double-pendulum"]()

Units are OpenMM's: nm, ps, amu, kJ/mol. Positions and velocities are plain NumPy arrays in nm and nm/ps.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import Any, ClassVar

import numpy as np
import openmm
from openmm import app, unit

__all__ = [
    "SYSTEMS",
    "ComparisonSettings",
    "MonitorSettings",
    "StepControl",
    "TestSystem",
    "alanine_dipeptide",
    "constraint_error",
    "diatomic_on_wall",
    "double_pendulum",
    "light_heavy_chain",
    "nitrogen_collision",
    "project_onto_constraints",
    "rigid_waters",
    "water_clash",
]


@dataclass(frozen=True)
class MonitorSettings:
    """One monitor of `VariableStepRattleIntegrator`: the arguments of its ``addMonitor``."""

    kind: str
    """Name of the monitor, a class constant of the integrator such as ``ConstraintMultipliers``."""
    weight: float = 1.0
    power: float = 1.0


@dataclass(frozen=True)
class StepControl:
    """How `VariableStepRattleIntegrator` is to choose its steps.

    The bounds are given relative to the nominal step, so that they move with it when the number of steps is adjusted.
    """

    monitors: tuple[MonitorSettings, ...]
    """The monitors; none gives fixed steps."""
    nominal_step_size: float
    """The step where the monitor has its reference value, in ps; a first guess where the steps are counted."""
    smallest_step_ratio: float = 1 / 50
    """Lower bound of the steps divided by the nominal step; 0 for no bound."""
    largest_step_ratio: float = 2.0
    """Upper bound of the steps divided by the nominal step; 0 for no bound."""
    update_method: str = "SemiExplicit"
    """Name of the recursion of the step density, a class constant of the integrator."""
    calibration_steps: int = 0
    """Trial steps from which the reference value is taken (``calibrate``); 0 for the value at the first step."""
    reference_values: tuple[float, ...] = ()
    """Reference values of the monitors, in their units, if they are known beforehand."""
    automatic_trial_steps: int = 0
    """Trial steps of the automatic step control, which takes the place of monitors, bounds and update; 0 for none."""

    @property
    def label(self) -> str:
        """A short name for tables and pictures."""
        if self.automatic_trial_steps:
            return "VRATTLE, automatic"
        if not self.monitors:
            return "RATTLE, fixed steps"
        names = (m.kind if m.power == 1.0 else f"{m.kind}^{m.power:g}" for m in self.monitors)
        return "VRATTLE, " + " and ".join(names)


@dataclass(frozen=True)
class ComparisonSettings:
    """How a system is run when integrators are compared on it."""

    total_time: float
    """Simulated time in ps."""
    force_evaluations: int
    """How often each integrator may compute the forces over that time."""
    controls: tuple[StepControl, ...]
    """The ways of step control that are compared with fixed steps."""
    constraint_tolerance: float = 1e-8
    """Relative tolerance of the constrained distances, the same for every integrator."""


@dataclass(frozen=True)
class TestSystem:
    """A system, a start that meets its constraints, and what to compare on it."""

    __test__: ClassVar[bool] = False  # not a test case, although its name begins like one

    name: str
    system: openmm.System
    topology: app.Topology
    positions: np.ndarray
    """nm, one row for each particle"""
    velocities: np.ndarray
    """nm/ps, tangent to the constraints"""
    description: str
    settings: ComparisonSettings
    parameters: tuple[tuple[str, float], ...] = ()
    """Names and values of global parameters, where they differ from the defaults in the System."""
    notes: tuple[str, ...] = ()
    """What was changed to make the system from what the user gave, in sentences."""


def double_pendulum(
    inner_mass: float = 1.0,
    outer_mass: float = 1000.0,
    inner_angle: float = 2.2,
    outer_angle: float = 0.5,
    gravity: float = 1.0,
) -> TestSystem:
    """A double pendulum of two rigid rods: the test of section 4 of Barth, Leimkuhler and Reich (1999).

    A pivot of 1e15 amu, in effect fixed, carries two bobs on rods of 1 nm, which swing in the plane z = 0. With a light
    inner bob (1 amu) and a heavy outer one (1000 amu) the light bob is whipped around whenever the rods pass through
    one line: the forces in the rods then rise by orders of magnitude for a moment, and steps that follow them pay.
    With the masses the other way round the forces in the rods hardly vary and all integrators do about equally well.
    The motion is chaotic, so compare energies and not trajectories.

    Args:
        inner_mass: mass of the bob on the first rod, in amu.
        outer_mass: mass of the bob on the second rod, in amu.
        inner_angle: angle of the first rod from the downward vertical at the start, in radians.
        outer_angle: the same for the second rod.
        gravity: acceleration downwards (against y) of both bobs, in nm/ps^2; the pivot feels none.

    Returns:
        The pendulum at rest; with the default arguments its energy is -288.493 kJ/mol.
    """
    masses = (1e15, inner_mass, outer_mass)
    length = 1.0  # nm
    system = openmm.System()
    for mass in masses:
        system.addParticle(mass)
    system.addConstraint(0, 1, length)
    system.addConstraint(1, 2, length)
    weight = openmm.CustomExternalForce("w*y")
    weight.addPerParticleParameter("w")
    for particle in (1, 2):
        weight.addParticle(particle, [masses[particle] * gravity])
    system.addForce(weight)

    inner = length * np.array([math.sin(inner_angle), -math.cos(inner_angle), 0.0])
    outer = inner + length * np.array([math.sin(outer_angle), -math.cos(outer_angle), 0.0])
    light_inside = inner_mass <= outer_mass
    return TestSystem(
        name="double-pendulum" if light_inside else "double-pendulum-heavy-inside",
        system=system,
        topology=_chain_topology(("pivot", "inner", "outer")),
        positions=np.array([np.zeros(3), inner, outer]),
        velocities=np.zeros((3, 3)),
        description=f"double pendulum, inner bob {inner_mass:g} amu, outer bob {outer_mass:g} amu",
        settings=ComparisonSettings(
            total_time=12.0,
            force_evaluations=78_400,
            controls=(
                StepControl(
                    monitors=(MonitorSettings("ConstraintMultipliers"),),
                    nominal_step_size=0.01 if light_inside else 1.5e-4,
                    smallest_step_ratio=1e-4,
                    largest_step_ratio=2.0,
                ),
            ),
        ),
    )


def light_heavy_chain(repulsion: bool = False) -> TestSystem:
    """A linear I-H-I with both bonds rigid, which is bent and straightens: a whip.

    When the two heavy atoms (126.9 amu) have pulled the chain straight, the hydrogen atom (1.008 amu) between them is
    flung across the line within a fraction of a femtosecond. The two bonds are strongly coupled through the light atom:
    OpenMM's constraint solver CCMA stops before it has met its tolerance here, and VerletIntegrator therefore loses
    energy whatever the tolerance. VariableVerletIntegrator, which takes its steps from the applied force, cannot
    run at all where there is none. The energy is 2.4756 kJ/mol.

    Args:
        repulsion: whether the heavy atoms repel each other, by the repulsive part of a Lennard-Jones potential
            (diameter 0.16 nm, depth 1 kJ/mol). Then an applied force sets in suddenly besides the constraint forces.
            Without it there is no applied force at all.
    """
    system = openmm.System()
    for mass in (126.9, 1.008, 126.9):
        system.addParticle(mass)
    length = 0.1609  # nm, the bond of HI
    system.addConstraint(0, 1, length)
    system.addConstraint(1, 2, length)
    if repulsion:
        system.addForce(_repulsion(0, 2, diameter=0.16, depth=1.0))
    positions = np.array(
        [
            [-0.13035287991719496, 0.0, 0.0],
            [0.0, 0.094323574451424086, 0.0],
            [0.13035287991719496, 0.0, 0.0],
        ]
    )
    velocities = np.array(
        [
            [0.13914834428899867, -0.00076072186030887707, 0.0],
            [0.0, 0.19153889697062798, 0.0],
            [-0.13914834428899867, -0.00076072186030887707, 0.0],
        ]
    )
    positions, velocities = project_onto_constraints(system, positions, velocities)
    return TestSystem(
        name="light-heavy-chain-repulsion" if repulsion else "light-heavy-chain",
        system=system,
        topology=_chain_topology(("I1", "H", "I2"), (app.element.iodine, app.element.hydrogen, app.element.iodine)),
        positions=positions,
        velocities=velocities,
        description=f"I-H-I with rigid bonds and {'repulsion' if repulsion else 'no other force'}",
        settings=ComparisonSettings(
            total_time=20.0,
            force_evaluations=16_000,
            controls=(
                StepControl(
                    monitors=(MonitorSettings("ConstraintAndAppliedForce" if repulsion else "ConstraintForce"),),
                    nominal_step_size=1.25e-3,
                    smallest_step_ratio=0.01,
                    largest_step_ratio=2.0 if repulsion else 10.0,
                    update_method="Explicit",
                ),
            ),
        ),
    )


def _repulsion(first: int, second: int, diameter: float, depth: float) -> openmm.Force:
    """The repulsive part of a Lennard-Jones potential between two particles, zero beyond its minimum.

    Args:
        first: index of one particle.
        second: index of the other.
        diameter: where the Lennard-Jones potential is zero, nm.
        depth: of its minimum, kJ/mol.
    """
    force = openmm.CustomBondForce(
        "step(2^(1/6)*diameter-r)*(4*depth*((diameter/r)^12-(diameter/r)^6)+depth)",
    )
    force.addPerBondParameter("diameter")
    force.addPerBondParameter("depth")
    force.addBond(first, second, [diameter, depth])
    return force


# ACE-ALA-NME near the minimum of amber14 in vacuum: residue, atom, x, y, z in nm.
_ALANINE_DIPEPTIDE = (
    ("ACE", "H1", -0.3256, 0.0272, 0.1745),
    ("ACE", "CH3", -0.2919, 0.0760, 0.0831),
    ("ACE", "H2", -0.3276, 0.1789, 0.0815),
    ("ACE", "H3", -0.3302, 0.0228, -0.0040),
    ("ACE", "C", -0.1409, 0.0765, 0.0793),
    ("ACE", "O", -0.0797, 0.1824, 0.0743),
    ("ALA", "N", -0.0807, -0.0423, 0.0803),
    ("ALA", "H", -0.1390, -0.1248, 0.0828),
    ("ALA", "CA", 0.0646, -0.0632, 0.0787),
    ("ALA", "HA", 0.1095, 0.0088, 0.1470),
    ("ALA", "CB", 0.0928, -0.2036, 0.1345),
    ("ALA", "HB1", 0.0506, -0.2793, 0.0684),
    ("ALA", "HB2", 0.2005, -0.2191, 0.1413),
    ("ALA", "HB3", 0.0496, -0.2138, 0.2340),
    ("ALA", "C", 0.1292, -0.0379, -0.0600),
    ("ALA", "O", 0.1971, -0.1245, -0.1148),
    ("NME", "N", 0.1055, 0.0802, -0.1183),
    ("NME", "H", 0.0486, 0.1459, -0.0669),
    ("NME", "C", 0.1569, 0.1202, -0.2491),
    ("NME", "H1", 0.1220, 0.0504, -0.3252),
    ("NME", "H2", 0.1227, 0.2207, -0.2737),
    ("NME", "H3", 0.2659, 0.1186, -0.2477),
)


def alanine_dipeptide(constraints: Any = app.HBonds, temperature: float = 300.0, seed: int = 8) -> TestSystem:
    """Alanine dipeptide (ACE-ALA-NME, 22 atoms) in vacuum with the force field amber14: a real molecule.

    The stiff angles and the thermal motion of many bonds leave no calm spells that longer steps could use: fixed steps
    are hard to beat here, and a monitor that sees nothing but the constraints does worse than they do.

    Args:
        constraints: ``openmm.app.HBonds`` (12 constraints) or ``openmm.app.AllBonds`` (21 constraints).
        temperature: temperature in K.
        seed: seed of the random numbers of the equilibration.

    Returns:
        The molecule after a short equilibration at the temperature.
    """
    names = {app.HBonds: "hbonds", app.AllBonds: "allbonds"}
    suffix = "" if temperature == 300.0 else f"-{temperature:g}-kelvin"
    if constraints not in names:
        raise ValueError("constraints must be openmm.app.HBonds or openmm.app.AllBonds")
    topology = app.Topology()
    chain = topology.addChain()
    residues: dict[str, Any] = {}
    for residue_name, atom_name, *_ in _ALANINE_DIPEPTIDE:
        if residue_name not in residues:
            residues[residue_name] = topology.addResidue(residue_name, chain)
        topology.addAtom(atom_name, app.Element.getBySymbol(atom_name[0]), residues[residue_name])
    topology.createStandardBonds()
    system = app.ForceField("amber14-all.xml").createSystem(
        topology, nonbondedMethod=app.NoCutoff, constraints=constraints, removeCMMotion=False
    )
    positions = np.array([row[2:] for row in _ALANINE_DIPEPTIDE])
    positions, velocities = _equilibrated(system, positions, temperature, seed)
    return TestSystem(
        name=f"alanine-dipeptide-{names[constraints]}{suffix}",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"alanine dipeptide in vacuum, {system.getNumConstraints()} rigid bonds, {temperature:g} K",
        settings=ComparisonSettings(total_time=2.0, force_evaluations=2000, controls=_MOLECULAR_CONTROLS),
    )


def rigid_waters(n: int = 8, temperature: float = 300.0, seed: int = 8) -> TestSystem:
    """A cluster of rigid TIP3P water molecules in vacuum: thermal water, which offers variable steps nothing to gain.

    Args:
        n: number of molecules; they are the n nearest to the centre of the box of water that ships with OpenMM.
        temperature: temperature in K.
        seed: seed of the random numbers of the equilibration.

    Returns:
        The cluster after a short equilibration at the temperature.
    """
    box = app.PDBFile(_openmm_data_file("tip3p.pdb"))
    coordinates = box.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    molecules = [[atom.index for atom in residue.atoms()] for residue in box.topology.residues()]
    if not 1 <= n <= len(molecules):
        raise ValueError(f"the number of water molecules must be between 1 and {len(molecules)}")
    oxygens = coordinates[[atoms[0] for atoms in molecules]]
    nearest = np.argsort(np.linalg.norm(oxygens - coordinates.mean(axis=0), axis=1), kind="stable")[:n]

    topology = app.Topology()
    chain = topology.addChain()
    for _ in range(n):
        residue = topology.addResidue("HOH", chain)
        for name in ("O", "H1", "H2"):
            topology.addAtom(name, app.Element.getBySymbol(name[0]), residue)
    topology.createStandardBonds()
    system = app.ForceField("tip3p.xml").createSystem(
        topology, nonbondedMethod=app.NoCutoff, rigidWater=True, removeCMMotion=False
    )
    positions = np.concatenate([coordinates[molecules[i]] for i in nearest])
    positions, velocities = _equilibrated(system, positions - positions.mean(axis=0), temperature, seed)
    return TestSystem(
        name="rigid-waters" if n == 8 else f"rigid-waters-{n}",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"{n} rigid TIP3P water molecules in vacuum",
        settings=ComparisonSettings(total_time=2.0, force_evaluations=2000, controls=_MOLECULAR_CONTROLS),
    )


# TIP3P: diameter and depth of the Lennard-Jones potential of O (nm, kJ/mol), charges of O and H.
_WATER_LENNARD_JONES = (0.315061, 0.6364)
_WATER_CHARGES = (-0.834, 0.417)
_WATER_BONDS = ((0, 1, 0.09572), (0, 2, 0.09572), (1, 2, 0.15139006545273223))


def water_clash() -> TestSystem:
    """Eight rigid water molecules, two of which overlap: a clash as in a badly built start.

    Two oxygen atoms are at half their Lennard-Jones diameter, where the repulsion is some 10,000 times that of thermal
    contacts. It drives the molecules apart within a few fs, and they strike their neighbours. Almost all of the
    difficulty lies in the applied force of two atoms, and most of it in the first moments, so monitors that see single
    particles pay here. The positions and velocities are in data/water_clash.json of this package.
    """
    data = json.loads((resources.files("openmmvrattle") / "data" / "water_clash.json").read_text(encoding="utf-8"))
    masses = data["masses"]
    molecules = len(masses) // 3
    system = openmm.System()
    force = openmm.NonbondedForce()
    for particle, mass in enumerate(masses):
        system.addParticle(mass)
        is_oxygen = particle % 3 == 0
        diameter, depth = _WATER_LENNARD_JONES if is_oxygen else (1.0, 0.0)
        force.addParticle(_WATER_CHARGES[0] if is_oxygen else _WATER_CHARGES[1], diameter, depth)
    topology = app.Topology()
    chain = topology.addChain()
    for molecule in range(molecules):
        residue = topology.addResidue("HOH", chain)
        for name in ("O", "H1", "H2"):
            topology.addAtom(name, app.Element.getBySymbol(name[0]), residue)
        for first, second, distance in _WATER_BONDS:
            system.addConstraint(3 * molecule + first, 3 * molecule + second, distance)
            force.addException(3 * molecule + first, 3 * molecule + second, 0.0, 1.0, 0.0)
    topology.createStandardBonds()
    system.addForce(force)
    return TestSystem(
        name="water-clash",
        system=system,
        topology=topology,
        positions=np.array(data["positions"]),
        velocities=np.array(data["velocities"]),
        description=f"{molecules} rigid water molecules, two of which overlap",
        settings=ComparisonSettings(total_time=0.2, force_evaluations=800, controls=(_COLLISION_CONTROL,)),
    )


# Nitrogen: the bond (nm), and diameter and depth of the Lennard-Jones potential between atoms (nm, kJ/mol).
_NITROGEN_BOND = 0.1098
_NITROGEN_LENNARD_JONES = (0.331, 0.2993)


def nitrogen_collision(speed: float = 5.0) -> TestSystem:
    """Two rigid N2 molecules that meet at high speed, as in a shock wave or a hot plasma.

    They start 1.2 nm apart, do not turn, and meet 0.1 nm off the centre. Before and after the collision there is hardly
    any force, so only a monitor that rises early enough helps.

    Args:
        speed: their relative speed, in nm/ps, which is km/s.
    """
    system = openmm.System()
    force = openmm.NonbondedForce()
    for _ in range(4):
        system.addParticle(14.007)
        force.addParticle(0.0, *_NITROGEN_LENNARD_JONES)
    for first in (0, 2):
        system.addConstraint(first, first + 1, _NITROGEN_BOND)
        force.addException(first, first + 1, 0.0, 1.0, 0.0)
    system.addForce(force)
    half = 0.5 * _NITROGEN_BOND
    axes = [np.array([math.cos(angle), math.sin(angle), 0.0]) for angle in (0.7, 2.0)]
    centres = [np.array([-0.6, 0.05, 0.0]), np.array([0.6, -0.05, 0.0])]
    positions = [
        centre + sign * half * axis for centre, axis in zip(centres, axes, strict=True) for sign in (-1.0, 1.0)
    ]
    velocities = np.zeros((4, 3))
    velocities[:2, 0], velocities[2:, 0] = 0.5 * speed, -0.5 * speed
    topology = app.Topology()
    chain = topology.addChain()
    for _ in range(2):
        residue = topology.addResidue("N2", chain)
        topology.addBond(*(topology.addAtom(name, app.element.nitrogen, residue) for name in ("N1", "N2")))
    return TestSystem(
        name=f"nitrogen-collision-{speed:g}",
        system=system,
        topology=topology,
        positions=np.array(positions),
        velocities=velocities,
        description=f"two rigid N2 molecules that collide at {speed:g} km/s",
        settings=ComparisonSettings(total_time=2.0 / speed, force_evaluations=400, controls=(_COLLISION_CONTROL,)),
    )


def diatomic_on_wall(speed: float = 2.0) -> TestSystem:
    """A rigid N2 molecule that flies against a wall, aslant, and comes back turning.

    The wall is the plane x = 0 and repels each atom with depth (0.25 nm / x)^12 of 1 kJ/mol at 0.25 nm.

    Args:
        speed: the speed of the molecule towards the wall, in nm/ps.
    """
    system = openmm.System()
    wall = openmm.CustomExternalForce("(0.25/x)^12")
    for particle in range(2):
        system.addParticle(14.007)
        wall.addParticle(particle)
    system.addConstraint(0, 1, _NITROGEN_BOND)
    system.addForce(wall)
    axis = np.array([math.cos(0.6), math.sin(0.6), 0.0])
    centre = np.array([0.9, 0.0, 0.0])
    half = 0.5 * _NITROGEN_BOND
    topology = _chain_topology(("N1", "N2"), (app.element.nitrogen, app.element.nitrogen))
    return TestSystem(
        name="diatomic-on-wall",
        system=system,
        topology=topology,
        positions=np.array([centre - half * axis, centre + half * axis]),
        velocities=np.tile([-speed, 0.0, 0.0], (2, 1)),
        description=f"a rigid N2 molecule that flies against a wall at {speed:g} km/s",
        settings=ComparisonSettings(total_time=2.0 / speed, force_evaluations=400, controls=(_COLLISION_CONTROL,)),
    )


_COLLISION_CONTROL = StepControl(
    monitors=(MonitorSettings("ForcePNorm", power=0.5),), nominal_step_size=1e-3, update_method="Explicit"
)

_MOLECULAR_CONTROLS = (
    StepControl(monitors=(MonitorSettings("ConstraintMultipliers"),), nominal_step_size=1e-3),
    StepControl(monitors=(MonitorSettings("ConstraintAndAppliedForce"),), nominal_step_size=1e-3),
)

SYSTEMS: dict[str, Callable[[], TestSystem]] = {
    "double-pendulum": double_pendulum,
    "double-pendulum-heavy-inside": functools.partial(double_pendulum, inner_mass=1000.0, outer_mass=1.0),
    "light-heavy-chain": light_heavy_chain,
    "light-heavy-chain-repulsion": functools.partial(light_heavy_chain, repulsion=True),
    "water-clash": water_clash,
    "nitrogen-collision-5": nitrogen_collision,
    "nitrogen-collision-20": functools.partial(nitrogen_collision, 20.0),
    "diatomic-on-wall": diatomic_on_wall,
    "alanine-dipeptide-hbonds": functools.partial(alanine_dipeptide, app.HBonds),
    "alanine-dipeptide-hbonds-1000-kelvin": functools.partial(alanine_dipeptide, app.HBonds, temperature=1000.0),
    "alanine-dipeptide-allbonds": functools.partial(alanine_dipeptide, app.AllBonds),
    "rigid-waters": rigid_waters,
    "rigid-waters-32": functools.partial(rigid_waters, 32),
}
"""The systems by the names under which the command line knows them; each value is called without arguments."""


def constraint_error(system: openmm.System, positions: np.ndarray) -> float:
    """The largest relative error of a constrained distance; 0 for a system without constraints.

    Args:
        system: the system whose constraints are checked.
        positions: positions in nm, one row for each particle.
    """
    first, second, distances = _constraint_arrays(system)
    if not len(distances):
        return 0.0
    lengths = np.linalg.norm(positions[first] - positions[second], axis=1)
    return float(np.max(np.abs(lengths / distances - 1.0)))


def project_onto_constraints(
    system: openmm.System, positions: np.ndarray, velocities: np.ndarray, tolerance: float = 1e-13
) -> tuple[np.ndarray, np.ndarray]:
    """Move positions and velocities onto the constraints of a system, by the mass-weighted shortest way.

    Dense matrices and Newton's method: meant for small systems, exact where iterative solvers stop early.

    Args:
        system: the system, with constraints that are independent of each other.
        positions: positions in nm, near to the constraints.
        velocities: velocities in nm/ps.
        tolerance: relative tolerance of the distances.

    Returns:
        The projected positions and velocities.
    """
    first, second, distances = _constraint_arrays(system)
    positions, velocities = np.array(positions, dtype=float), np.array(velocities, dtype=float)
    if not len(distances):
        return positions, velocities
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    inverse_masses = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)

    def jacobian() -> np.ndarray:
        rows = np.arange(len(distances))
        separations = positions[first] - positions[second]
        matrix = np.zeros((len(distances), len(masses), 3))
        matrix[rows, first] = 2.0 * separations
        matrix[rows, second] = -2.0 * separations
        return matrix

    def correction(matrix: np.ndarray, violation: np.ndarray) -> np.ndarray:
        coupling = np.einsum("kia,i,lia->kl", matrix, inverse_masses, matrix)
        multipliers = np.linalg.solve(coupling, violation)
        return np.einsum("i,kia,k->ia", inverse_masses, matrix, multipliers)

    for _ in range(50):
        violation = np.sum((positions[first] - positions[second]) ** 2, axis=1) - distances**2
        if np.max(np.abs(violation) / distances**2) <= 2.0 * tolerance:
            break
        positions -= correction(jacobian(), violation)
    else:
        raise ValueError("the positions are too far from the constraints to be projected onto them")
    matrix = jacobian()
    velocities -= correction(matrix, np.einsum("kia,ia->k", matrix, velocities))
    return positions, velocities


def _constraint_arrays(system: openmm.System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two particles and the distance (nm) of each constraint."""
    constraints = [system.getConstraintParameters(i) for i in range(system.getNumConstraints())]
    first = np.array([c[0] for c in constraints], dtype=int)
    second = np.array([c[1] for c in constraints], dtype=int)
    distances = np.array([c[2].value_in_unit(unit.nanometer) for c in constraints])
    return first, second, distances


def _equilibrated(
    system: openmm.System, positions: np.ndarray, temperature: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities, on the constraints, after 2 ps of Langevin dynamics from a minimum of the energy."""
    integrator = openmm.LangevinMiddleIntegrator(temperature * unit.kelvin, 10.0 / unit.picosecond, 0.001)
    integrator.setRandomNumberSeed(seed)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 1e-2)
    context.setVelocitiesToTemperature(temperature * unit.kelvin, seed)
    integrator.step(2000)
    state = context.getState(getPositions=True, getVelocities=True)
    return project_onto_constraints(
        system,
        state.getPositions(asNumpy=True).value_in_unit(unit.nanometer),
        state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond),
    )


def _chain_topology(names: tuple[str, ...], elements: tuple[Any, ...] | None = None) -> app.Topology:
    """A topology of one residue in which each atom is bonded to the one before."""
    topology = app.Topology()
    residue = topology.addResidue("CHN", topology.addChain())
    atoms = [
        topology.addAtom(name, element, residue)
        for name, element in zip(names, elements or (None,) * len(names), strict=True)
    ]
    for left, right in itertools.pairwise(atoms):
        topology.addBond(left, right)
    return topology


def _openmm_data_file(name: str) -> str:
    """The path of a file among the data that ship with openmm.app."""
    return str(resources.files(app) / "data" / name)
