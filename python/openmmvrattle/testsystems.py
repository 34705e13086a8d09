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
    "ExpressionConstraint",
    "MonitorSettings",
    "StepControl",
    "TestSystem",
    "alanine_dipeptide",
    "argon_cluster",
    "colliding_water_clusters",
    "constraint_error",
    "diatomic_on_wall",
    "double_pendulum",
    "elastic_rod",
    "flexible_waters",
    "independent_whips",
    "ion_pair",
    "light_heavy_chain",
    "long_light_heavy_chain",
    "nitrogen_collision",
    "peptide_in_water",
    "polymer",
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
    """The monitors; none gives fixed steps, or automatic ones."""
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
class ExpressionConstraint:
    """A constraint g = 0 that OpenMM's System cannot hold: the arguments of the integrator's ``addConstraint``."""

    expression: str
    particles: tuple[int, ...]
    """The particles whose coordinates are x1, y1, z1, x2, ... in the expression, in this order."""
    parameters: tuple[tuple[str, float], ...] = ()
    """Names and values."""


@dataclass(frozen=True)
class TestSystem:
    """A system, a start that meets its constraints, and what to compare on it.

    Most systems are nothing but their `system`. Those that have expression constraints, or a force group that only a
    monitor reads, need `prepare` before the integrator gets its Context, and `force_groups` where their energy is asked
    for.
    """

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
    expression_constraints: tuple[ExpressionConstraint, ...] = ()
    """Constraints that the integrator has to be given, in this order; see `prepare`."""
    monitor_force_group: int | None = None
    """The force group that only a monitor ``ForceGroupEnergy`` reads, if there is one."""

    @property
    def force_groups(self) -> int:
        """The force groups that act in the system, all but that of the monitor, as the bits of a number."""
        everything = 0xFFFFFFFF
        return everything if self.monitor_force_group is None else everything & ~(1 << self.monitor_force_group)

    def add_constraints(self, integrator: Any) -> None:
        """Give an integrator the expression constraints of the system; without any this does nothing.

        Args:
            integrator: a `VariableStepRattleIntegrator` that has no Context yet.
        """
        if self.expression_constraints and not hasattr(integrator, "addConstraint"):
            raise ValueError(
                f"{type(integrator).__name__} cannot run {self.name}: it has no constraints given by expressions; "
                "use VariableStepRattleIntegrator, without monitors for fixed steps."
            )
        for constraint in self.expression_constraints:
            integrator.addConstraint(constraint.expression, list(constraint.particles), dict(constraint.parameters))

    def prepare(self, integrator: Any) -> None:
        """Give an integrator the expression constraints, and leave the monitor's force group out of the dynamics.

        Args:
            integrator: an integrator that has no Context yet.
        """
        self.add_constraints(integrator)
        if self.monitor_force_group is not None:
            integrator.setIntegrationForceGroups(self.force_groups)
            if hasattr(integrator, "setMonitorForceGroup"):
                integrator.setMonitorForceGroup(self.monitor_force_group)


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
        name="diatomic-on-wall" if speed == 2.0 else f"diatomic-on-wall-{speed:g}",
        system=system,
        topology=topology,
        positions=np.array([centre - half * axis, centre + half * axis]),
        velocities=np.tile([-speed, 0.0, 0.0], (2, 1)),
        description=f"a rigid N2 molecule that flies against a wall at {speed:g} km/s",
        settings=ComparisonSettings(total_time=2.0 / speed, force_evaluations=400, controls=(_COLLISION_CONTROL,)),
    )


# The rod of the paper's section 5: offsets of the points of a section from its centre along the two directors (nm),
# stiffness against bending about the first and the second director and against twist (kJ nm/mol), mass per length
# (amu/nm); the walls: their distance from the axis and the diameter (nm) and depth (kJ/mol) of their potential.
_ROD_OFFSETS = (0.3, 0.3)
_ROD_STIFFNESS = (0.1, 0.1, 0.4)
_ROD_DENSITY = 1.0
_ROD_WALL = 0.65
_ROD_LENNARD_JONES = (0.25, 0.1)
_ROD_SHAPE = np.array([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [-0.3, -0.3, 0.0]])
"""The points of a section about its centre at the start, where the directors are the axes x and y."""
_ROD_MONITOR_GROUP = 31
_ROD_NORM_ORDER = 24


def _rod_directors() -> str:
    """The means m1, m2 of the directors of two sections, of points 1, 2, 3 and 4, 5, 6; and their centres ca, cb."""
    means = [f"m{k}{a}=({a}{k}-c{a}a+{a}{k + 3}-c{a}b)/(2*offset{k})" for k in (1, 2) for a in "xyz"]
    centres = [f"c{a}a=({a}1+{a}2+{a}3)/3; c{a}b=({a}4+{a}5+{a}6)/3" for a in "xyz"]
    return "; ".join(means + centres)


_ROD_NORMALS = {a: f"m1{b}*m2{c}-m1{c}*m2{b}" for a, b, c in ("xyz", "yzx", "zxy")}
"""The components of the mean direction of the axis, m1 x m2."""


def _rod_node_expressions() -> tuple[str, ...]:
    """The components of (cb - ca)/spacing = m1 x m2: the rod cannot stretch, and its sections stay across its axis."""
    return tuple(f"(c{a}b-c{a}a)/spacing-({_ROD_NORMALS[a]}); {_rod_directors()}" for a in "xyz")


def _rod_elasticity(sections: int, spacing: float) -> openmm.Force:
    """Bending and twist between neighbouring sections: spacing/2 (K1 u1^2 + K2 u2^2 + K3 u3^2)."""
    slopes = [f"e{k}{a}=({a}{k + 3}-c{a}b-{a}{k}+c{a}a)/(offset{k}*spacing)" for k in (1, 2) for a in "xyz"]
    normals = [f"n{a}={normal}" for a, normal in _ROD_NORMALS.items()]
    force = openmm.CustomCompoundBondForce(
        6,
        "0.5*spacing*(bending1*u1^2+bending2*u2^2+twist*u3^2); u1=nx*e2x+ny*e2y+nz*e2z; u2=-(nx*e1x+ny*e1y+nz*e1z);"
        f" u3=m2x*e1x+m2y*e1y+m2z*e1z; {'; '.join(slopes + normals)}; {_rod_directors()}",
    )
    for name in ("spacing", "offset1", "offset2", "bending1", "bending2", "twist"):
        force.addPerBondParameter(name)
    for section in range(sections - 1):
        particles = list(range(3 * section, 3 * section + 6))
        force.addBond(particles, [spacing, *_ROD_OFFSETS, *_ROD_STIFFNESS])
    return force


def _rod_walls(sections: int, energy: str) -> openmm.Force:
    """The same energy for each section but the clamped one, an expression of the x of its centre, called x.

    Args:
        sections: their number.
        energy: the expression; wall is the distance of the walls from x = 0.
    """
    force = openmm.CustomCompoundBondForce(3, f"{energy}; x=(x1+x2+x3)/3")
    force.addPerBondParameter("wall")
    for section in range(1, sections):
        force.addBond([3 * section, 3 * section + 1, 3 * section + 2], [_ROD_WALL])
    return force


def _rod_nearness(sections: int, monitor: str) -> openmm.Force:
    """How near the rod is to the walls, as a potential energy that a monitor reads; D are the distances from the walls.

    Args:
        sections: their number.
        monitor: ``smooth`` for the sum of D^-24 over sections and walls, ``maximum`` for the largest 1/D.
    """
    if monitor == "smooth":
        return _rod_walls(sections, f"(wall-x)^(-{_ROD_NORM_ORDER})+(wall+x)^(-{_ROD_NORM_ORDER})")
    if monitor != "maximum":
        raise ValueError(f"the monitor of the rod must be 'smooth' or 'maximum', not {monitor!r}")
    moving = range(1, sections)
    if len(moving) > 32:
        raise ValueError("the monitor 'maximum' can take 33 sections at most, one force group each; use 'smooth'")
    largest = functools.reduce(lambda rest, section: f"max({rest},abs(centre{section}))", moving, "0")
    force = openmm.CustomCVForce(f"1/({_ROD_WALL}-{largest})")
    for section in moving:
        centre = openmm.CustomCompoundBondForce(3, "(x1+x2+x3)/3")
        centre.addBond([3 * section, 3 * section + 1, 3 * section + 2], [])
        force.addCollectiveVariable(f"centre{section}", centre)
    return force


def _rod_system(sections: int, spacing: float, monitor: str) -> openmm.System:
    """Masses, rigid sections, elasticity, walls, and the force group of the monitor."""
    system = openmm.System()
    for particle in range(3 * sections):
        system.addParticle(0.0 if particle < 3 else _ROD_DENSITY * spacing / 3)
    for section in range(1, sections):
        for first, second in ((0, 1), (0, 2), (1, 2)):
            distance = float(np.linalg.norm(_ROD_SHAPE[first] - _ROD_SHAPE[second]))
            system.addConstraint(3 * section + first, 3 * section + second, distance)
    diameter, depth = _ROD_LENNARD_JONES
    wall = "+".join(f"(({diameter}/(wall{sign}x))^12-({diameter}/(wall{sign}x))^6)" for sign in "-+")
    system.addForce(_rod_elasticity(sections, spacing))
    system.addForce(_rod_walls(sections, f"4*{depth}*({wall})"))
    nearness = _rod_nearness(sections, monitor)
    nearness.setForceGroup(_ROD_MONITOR_GROUP)
    system.addForce(nearness)
    return system


def elastic_rod(
    sections: int = 10, length: float = 1.0, angular_speed: float = 3.2, monitor: str = "smooth"
) -> TestSystem:
    """An elastic rod that swings against a wall: the test of section 5 of Barth, Leimkuhler and Reich (1999).

    A rod that bends and twists but neither stretches nor shears (a Cosserat rod), cut into sections. Each section is
    three points of equal mass, held rigid by three distance constraints: q1 = c + 0.3 d1, q2 = c + 0.3 d2 and
    q3 = c - 0.3 d1 - 0.3 d2 nm, with the centre c and two directors d1, d2. Neighbours are joined by three constraints
    given by expressions, (c' - c)/spacing = d1 x d2 with the directors averaged over the two. The first section is
    clamped: its mass is 0. Two walls, planes at x = -0.65 and 0.65 nm, act on the centres of the others by a
    Lennard-Jones potential (0.25 nm, 0.1 kJ/mol).

    The rod stands upright at first and turns about its foot towards the wall, which its end meets at 0.17 ps: the only
    difficulty is the force of the wall, and the monitor that sees it coming is the distance from the wall, the paper's
    U3 = max D^-a. The force group `monitor_force_group` holds it for ``ForceGroupEnergy``: with the monitor ``smooth``
    as the sum of D^-24 over all distances D, to be raised to the power a/24, which is nearly the maximum but smooth;
    with ``maximum`` as the largest 1/D, to be raised to the power a.

    OpenMM's own integrators cannot run the rod. Call `prepare` before the integrator gets its Context:

    >>> from openmmvrattle import VariableStepRattleIntegrator
    >>> rod = elastic_rod()
    >>> integrator = VariableStepRattleIntegrator(0.02)
    >>> rod.prepare(integrator)

    and ask for the energy with ``context.getState(energy=True, groups=rod.force_groups)``.

    Args:
        sections: the number of sections, the clamped one among them.
        length: of the rod, in nm.
        angular_speed: of all sections about the foot of the rod at the start, in rad/ps.
        monitor: what the monitor's force group holds, ``smooth`` or ``maximum``.

    Returns:
        The rod; with the default arguments its energy is 1.493568 kJ/mol.
    """
    if sections < 2:
        raise ValueError("the rod must have at least 2 sections")
    if not (length > 0.0 and math.isfinite(length)):
        raise ValueError("the length of the rod must be positive")
    spacing = length / sections
    height = (np.arange(sections) + 0.5) * spacing
    positions = _ROD_SHAPE + height[:, None, None] * [0.0, 0.0, 1.0]
    velocities = np.zeros((sections, 3, 3))
    velocities[1:, :, 0] = angular_speed * (height[1:, None] - spacing)
    velocities[1:, :, 2] = -angular_speed * _ROD_SHAPE[:, 0]
    parameters = (("spacing", spacing), ("offset1", _ROD_OFFSETS[0]), ("offset2", _ROD_OFFSETS[1]))
    expressions = _rod_node_expressions()
    return TestSystem(
        name="elastic-rod",
        system=_rod_system(sections, spacing, monitor),
        topology=_rod_topology(sections),
        positions=positions.reshape(-1, 3),
        velocities=velocities.reshape(-1, 3),
        description=f"elastic rod of {sections} sections between two walls",
        settings=ComparisonSettings(
            total_time=1.0,
            force_evaluations=1000,
            controls=(
                StepControl(
                    monitors=(MonitorSettings("ForceGroupEnergy", power=_rod_power(3.0, monitor)),),
                    nominal_step_size=0.0065,
                    smallest_step_ratio=0.0,
                    largest_step_ratio=0.0,
                    update_method="Explicit",
                ),
                StepControl(monitors=(MonitorSettings("ConstraintMultipliers"),), nominal_step_size=1e-3),
                StepControl(monitors=(MonitorSettings("ConstraintForce"),), nominal_step_size=1e-3),
            ),
        ),
        expression_constraints=tuple(
            ExpressionConstraint(expression, tuple(range(3 * section, 3 * section + 6)), parameters)
            for section in range(sections - 1)
            for expression in expressions
        ),
        monitor_force_group=_ROD_MONITOR_GROUP,
    )


def _rod_power(exponent: float, monitor: str) -> float:
    """The power of the monitor ForceGroupEnergy that makes it the largest D^-exponent, or its smooth form."""
    return exponent / _ROD_NORM_ORDER if monitor == "smooth" else exponent


def _rod_topology(sections: int) -> app.Topology:
    """A residue of three points for each section."""
    topology = app.Topology()
    chain = topology.addChain()
    for _ in range(sections):
        residue = topology.addResidue("SEC", chain)
        for name in ("Q1", "Q2", "Q3"):
            topology.addAtom(name, None, residue)
    return topology


_COLLISION_CONTROL = StepControl(
    monitors=(MonitorSettings("ForcePNorm", power=0.5),), nominal_step_size=1e-3, update_method="Explicit"
)

_MOLECULAR_CONTROLS = (
    StepControl(monitors=(MonitorSettings("ConstraintMultipliers"),), nominal_step_size=1e-3),
    StepControl(monitors=(MonitorSettings("ConstraintAndAppliedForce"),), nominal_step_size=1e-3),
)

_FORCE_CONTROL = (StepControl(monitors=(MonitorSettings("ConstraintAndAppliedForce"),), nominal_step_size=1e-3),)
_BOLTZMANN = 0.00831446261815324  # kJ/mol/K


def _thermal_velocities(
    system: openmm.System, positions: np.ndarray, temperature: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Positions on the constraints, and velocities of the Maxwell-Boltzmann distribution that are tangent to them."""
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    # Drawn for free particles and projected in the mass metric, they have the distribution of the constrained ones.
    velocities = random.standard_normal(positions.shape) * np.sqrt(_BOLTZMANN * temperature / masses)[:, None]
    return project_onto_constraints(system, positions, velocities)


def long_light_heavy_chain(atoms: int = 8, temperature: float = 300.0, seed: int = 1) -> TestSystem:
    """A chain of iodine and hydrogen by turns with rigid bonds and no other force, in thermal motion.

    Every hydrogen atom is a joint that whips when its two neighbours pull it straight.

    Args:
        atoms: their number.
        temperature: temperature in K.
        seed: seed of the start.
    """
    random = np.random.default_rng(seed)
    system = openmm.System()
    for atom in range(atoms):
        system.addParticle(126.9 if atom % 2 == 0 else 1.008)
    length = 0.1609  # nm, the bond of HI
    positions = [np.zeros(3)]
    for atom in range(1, atoms):
        system.addConstraint(atom - 1, atom, length)
        turn = math.radians(40.0) * (-1) ** atom + random.normal(0.0, 0.2)
        axis = np.array([math.cos(turn), math.sin(turn), random.normal(0.0, 0.2)])
        positions.append(positions[-1] + length * axis / np.linalg.norm(axis))
    positions, velocities = _thermal_velocities(system, np.array(positions), temperature, random)
    elements = tuple(app.element.iodine if i % 2 == 0 else app.element.hydrogen for i in range(atoms))
    return TestSystem(
        name="long-light-heavy-chain",
        system=system,
        topology=_chain_topology(tuple(f"A{i}" for i in range(atoms)), elements),
        positions=positions,
        velocities=velocities,
        description=f"chain of {atoms} I and H by turns, rigid bonds, {temperature:g} K",
        settings=ComparisonSettings(total_time=10.0, force_evaluations=8000, controls=_FORCE_CONTROL),
    )


def independent_whips(molecules: int = 64, temperature: float = 300.0, seed: int = 1) -> TestSystem:
    """Many I-CH2-I with rigid bonds and no angle term that do not see each other.

    One of them is always in a whip, so a step that is the same for all has little to gain.

    Args:
        molecules: their number.
        temperature: temperature in K.
        seed: seed of the start.
    """
    random = np.random.default_rng(seed)
    system = openmm.System()
    length = 0.2132  # nm, the bond of CH2I2
    positions = []
    topology = app.Topology()
    chain = topology.addChain()
    for molecule in range(molecules):
        middle = np.array([molecule % 8, molecule // 8 % 8, molecule // 64], dtype=float)
        axes = random.standard_normal((2, 3))
        ends = middle + length * axes / np.linalg.norm(axes, axis=1)[:, None]
        positions += [ends[0], middle, ends[1]]
        residue = topology.addResidue("CH2", chain)
        for name, mass, element in (
            ("I1", 126.9, app.element.iodine),
            ("C", 14.027, app.element.carbon),
            ("I2", 126.9, app.element.iodine),
        ):
            system.addParticle(mass)
            topology.addAtom(name, element, residue)
        system.addConstraint(3 * molecule, 3 * molecule + 1, length)
        system.addConstraint(3 * molecule + 1, 3 * molecule + 2, length)
    positions, velocities = _thermal_velocities(system, np.array(positions), temperature, random)
    return TestSystem(
        name="independent-whips",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"{molecules} I-CH2-I with rigid bonds that do not see each other, {temperature:g} K",
        settings=ComparisonSettings(total_time=5.0, force_evaluations=2000, controls=_FORCE_CONTROL),
    )


def ion_pair() -> TestSystem:
    """A sodium and a chloride ion that fall towards each other and bounce off, again and again; no constraint."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    # Diameters and depths of Joung and Cheatham for SPC/E.
    for mass, charge, diameter, depth in ((22.99, 1.0, 0.2160, 1.4754), (35.45, -1.0, 0.4830, 0.0535)):
        system.addParticle(mass)
        force.addParticle(charge, diameter, depth)
    system.addForce(force)
    return TestSystem(
        name="ion-pair",
        system=system,
        topology=_chain_topology(("NA", "CL"), (app.element.sodium, app.element.chlorine)),
        positions=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        velocities=np.array([[0.0, -0.3, 0.0], [0.0, 0.3 * 22.99 / 35.45, 0.0]]),
        description="Na+ and Cl- that fall towards each other",
        settings=ComparisonSettings(total_time=3.0, force_evaluations=2000, controls=_FORCE_CONTROL),
    )


def colliding_water_clusters(speed: float = 3.0, seed: int = 1) -> TestSystem:
    """Two clusters of four rigid waters that collide.

    Args:
        speed: their relative speed in nm/ps, which is km/s.
        seed: seed of the equilibration of both.
    """
    left, right = rigid_waters(4, 150.0, 2 * seed), rigid_waters(4, 150.0, 2 * seed + 1)
    system = openmm.System()
    force = openmm.NonbondedForce()
    for half in (left, right):
        first = system.getNumParticles()
        source = next(f for f in half.system.getForces() if isinstance(f, openmm.NonbondedForce))
        for i in range(half.system.getNumParticles()):
            system.addParticle(half.system.getParticleMass(i))
            force.addParticle(*source.getParticleParameters(i))
        for k in range(half.system.getNumConstraints()):
            i, j, distance = half.system.getConstraintParameters(k)
            system.addConstraint(first + i, first + j, distance)
            force.addException(first + i, first + j, 0.0, 1.0, 0.0)
    system.addForce(force)
    away = np.array([0.7, 0.0, 0.0])
    motion = np.array([0.5 * speed, 0.0, 0.0])
    topology = app.Topology()
    chain = topology.addChain()
    for _ in range(8):
        residue = topology.addResidue("HOH", chain)
        for name in ("O", "H1", "H2"):
            topology.addAtom(name, app.Element.getBySymbol(name[0]), residue)
    return TestSystem(
        name="colliding-water-clusters",
        system=system,
        topology=topology,
        positions=np.concatenate([left.positions - away, right.positions + away]),
        velocities=np.concatenate([left.velocities + motion, right.velocities - motion]),
        description=f"two clusters of four rigid waters that collide at {speed:g} km/s",
        settings=ComparisonSettings(total_time=1.0, force_evaluations=2000, controls=_FORCE_CONTROL),
    )


def peptide_in_water(waters: int = 40, temperature: float = 300.0, seed: int = 1) -> TestSystem:
    """Alanine dipeptide in a droplet of rigid water, with the force fields amber14 and TIP3P.

    Args:
        waters: the number of water molecules.
        temperature: temperature in K.
        seed: seed of the equilibration.
    """
    peptide = alanine_dipeptide(temperature=temperature, seed=seed)
    modeller = app.Modeller(peptide.topology, peptide.positions * unit.nanometer)
    force_field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    modeller.addSolvent(force_field, numAdded=3 * waters)
    places = np.array(modeller.positions.value_in_unit(unit.nanometer))
    atoms = [[atom.index for atom in residue.atoms()] for residue in modeller.topology.residues()]
    solvent = [residue for residue in modeller.topology.residues() if residue.name == "HOH"]
    centre = places[: peptide.topology.getNumAtoms()]
    near = sorted(solvent, key=lambda residue: np.linalg.norm(centre - places[atoms[residue.index][0]], axis=1).min())
    modeller.delete(near[waters:])
    system = force_field.createSystem(
        modeller.topology, nonbondedMethod=app.NoCutoff, constraints=app.HBonds, removeCMMotion=False
    )
    positions, velocities = _equilibrated(
        system, np.array(modeller.positions.value_in_unit(unit.nanometer)), temperature, seed, 500, 0.001, 100.0
    )
    return TestSystem(
        name="peptide-in-water",
        system=system,
        topology=modeller.topology,
        positions=positions,
        velocities=velocities,
        description=f"alanine dipeptide in a droplet of {waters} rigid TIP3P waters, {temperature:g} K",
        settings=ComparisonSettings(total_time=0.5, force_evaluations=500, controls=_FORCE_CONTROL),
    )


def polymer(beads: int = 30, temperature: float = 300.0, seed: int = 1) -> TestSystem:
    """A chain of CH2 groups as single particles, with rigid bonds, stiff angles and Lennard-Jones: polyethylene.

    Args:
        beads: the number of groups.
        temperature: temperature in K.
        seed: seed of the start and the equilibration.
    """
    random = np.random.default_rng(seed)
    system = openmm.System()
    angle, torsion, contact = openmm.HarmonicAngleForce(), openmm.RBTorsionForce(), openmm.NonbondedForce()
    length, opening = 0.153, math.radians(114.0)
    positions = []
    for i in range(beads):
        system.addParticle(14.027)
        contact.addParticle(0.0, 0.395, 0.382)
        half = 0.5 * (math.pi - opening)
        positions.append([i * length * math.cos(half), (i % 2) * length * math.sin(half), 0.0])
        if i > 0:
            system.addConstraint(i - 1, i, length)
        if i > 1:
            angle.addAngle(i - 2, i - 1, i, opening, 519.6)
        if i > 2:
            torsion.addTorsion(i - 3, i - 2, i - 1, i, 8.397, 16.786, 1.134, -26.318, 0.0, 0.0)
    contact.createExceptionsFromBonds([(i - 1, i) for i in range(1, beads)], 0.0, 0.0)
    for force in (angle, torsion, contact):
        system.addForce(force)
    start = np.array(positions) + random.normal(0.0, 1e-3, (beads, 3))
    start, velocities = _equilibrated(system, start, temperature, seed)
    return TestSystem(
        name="polymer",
        system=system,
        topology=_chain_topology(tuple(f"C{i}" for i in range(beads)), (app.element.carbon,) * beads),
        positions=start,
        velocities=velocities,
        description=f"chain of {beads} CH2 with rigid bonds, {temperature:g} K",
        settings=ComparisonSettings(total_time=2.0, force_evaluations=1000, controls=_FORCE_CONTROL),
    )


def argon_cluster(atoms: int = 55, temperature: float = 40.0, seed: int = 1) -> TestSystem:
    """A liquid droplet of argon: soft forces only, and no constraint.

    Args:
        atoms: their number.
        temperature: temperature in K.
        seed: seed of the equilibration.
    """
    system = openmm.System()
    force = openmm.NonbondedForce()
    grid = np.array(list(itertools.product(range(-3, 4), repeat=3)), dtype=float)
    places = 0.38 * grid[np.argsort(np.sum(grid**2, axis=1), kind="stable")[:atoms]]
    topology = app.Topology()
    chain = topology.addChain()
    for _ in range(atoms):
        system.addParticle(39.95)
        force.addParticle(0.0, 0.34, 0.996)
        topology.addAtom("AR", app.element.argon, topology.addResidue("AR", chain))
    system.addForce(force)
    positions, velocities = _equilibrated(system, places, temperature, seed)
    return TestSystem(
        name="argon-cluster",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"droplet of {atoms} argon atoms, {temperature:g} K",
        settings=ComparisonSettings(total_time=20.0, force_evaluations=1000, controls=_FORCE_CONTROL),
    )


def flexible_waters(n: int = 8, temperature: float = 300.0, seed: int = 1) -> TestSystem:
    """A cluster of water molecules with harmonic bonds and angles, so that no distance is constrained.

    Args:
        n: number of molecules.
        temperature: temperature in K.
        seed: seed of the equilibration.
    """
    rigid = rigid_waters(n, temperature, seed)
    system = app.ForceField("tip3p.xml").createSystem(
        rigid.topology, nonbondedMethod=app.NoCutoff, rigidWater=False, flexibleConstraints=False, removeCMMotion=False
    )
    positions, velocities = _equilibrated(system, rigid.positions, temperature, seed, step=0.0002)
    return TestSystem(
        name="flexible-waters",
        system=system,
        topology=rigid.topology,
        positions=positions,
        velocities=velocities,
        description=f"{n} flexible TIP3P water molecules in vacuum, {temperature:g} K",
        settings=ComparisonSettings(total_time=0.5, force_evaluations=1000, controls=_FORCE_CONTROL),
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
    "elastic-rod": elastic_rod,
    "alanine-dipeptide-hbonds": functools.partial(alanine_dipeptide, app.HBonds),
    "alanine-dipeptide-hbonds-1000-kelvin": functools.partial(alanine_dipeptide, app.HBonds, temperature=1000.0),
    "alanine-dipeptide-allbonds": functools.partial(alanine_dipeptide, app.AllBonds),
    "rigid-waters": rigid_waters,
    "rigid-waters-32": functools.partial(rigid_waters, 32),
    "long-light-heavy-chain": long_light_heavy_chain,
    "independent-whips": independent_whips,
    "diatomic-on-wall-5": functools.partial(diatomic_on_wall, 5.0),
    "diatomic-on-wall-10": functools.partial(diatomic_on_wall, 10.0),
    "ion-pair": ion_pair,
    "colliding-water-clusters": colliding_water_clusters,
    "peptide-in-water": peptide_in_water,
    "polymer": polymer,
    "argon-cluster": argon_cluster,
    "flexible-waters": flexible_waters,
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
    system: openmm.System,
    positions: np.ndarray,
    temperature: float,
    seed: int,
    steps: int = 2000,
    step: float = 0.001,
    minimization_tolerance: float = 1e-2,  # kJ/mol/nm
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities, on the constraints, after some Langevin dynamics from a minimum of the energy."""
    integrator = openmm.LangevinMiddleIntegrator(temperature * unit.kelvin, 10.0 / unit.picosecond, step)
    integrator.setRandomNumberSeed(seed)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, minimization_tolerance)
    context.setVelocitiesToTemperature(temperature * unit.kelvin, seed)
    integrator.step(steps)
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
