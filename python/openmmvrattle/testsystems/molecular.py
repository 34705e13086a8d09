# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Water, ions, argon, nitrogen, a peptide, a polymer: molecules as simulations have them."""

from __future__ import annotations

import itertools
import json
import math
from importlib import resources
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from .base import (
    COLLISION_CONTROL,
    FORCE_CONTROL,
    MOLECULAR_CONTROLS,
    ComparisonSettings,
    TestSystem,
    chain_topology,
    equilibrated,
)

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
    positions, velocities = equilibrated(system, positions, temperature, seed)
    return TestSystem(
        name=f"alanine-dipeptide-{names[constraints]}{suffix}",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"alanine dipeptide in vacuum, {system.getNumConstraints()} rigid bonds, {temperature:g} K",
        settings=ComparisonSettings(total_time=2.0, force_evaluations=2000, controls=MOLECULAR_CONTROLS),
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
    positions, velocities = equilibrated(system, positions - positions.mean(axis=0), temperature, seed)
    return TestSystem(
        name="rigid-waters" if n == 8 else f"rigid-waters-{n}",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"{n} rigid TIP3P water molecules in vacuum",
        settings=ComparisonSettings(total_time=2.0, force_evaluations=2000, controls=MOLECULAR_CONTROLS),
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
        settings=ComparisonSettings(total_time=0.2, force_evaluations=800, controls=(COLLISION_CONTROL,)),
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
        settings=ComparisonSettings(total_time=2.0 / speed, force_evaluations=400, controls=(COLLISION_CONTROL,)),
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
    topology = chain_topology(("N1", "N2"), (app.element.nitrogen, app.element.nitrogen))
    return TestSystem(
        name="diatomic-on-wall" if speed == 2.0 else f"diatomic-on-wall-{speed:g}",
        system=system,
        topology=topology,
        positions=np.array([centre - half * axis, centre + half * axis]),
        velocities=np.tile([-speed, 0.0, 0.0], (2, 1)),
        description=f"a rigid N2 molecule that flies against a wall at {speed:g} km/s",
        settings=ComparisonSettings(total_time=2.0 / speed, force_evaluations=400, controls=(COLLISION_CONTROL,)),
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
        topology=chain_topology(("NA", "CL"), (app.element.sodium, app.element.chlorine)),
        positions=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        velocities=np.array([[0.0, -0.3, 0.0], [0.0, 0.3 * 22.99 / 35.45, 0.0]]),
        description="Na+ and Cl- that fall towards each other",
        settings=ComparisonSettings(total_time=3.0, force_evaluations=2000, controls=FORCE_CONTROL),
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
        settings=ComparisonSettings(total_time=1.0, force_evaluations=2000, controls=FORCE_CONTROL),
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
    positions, velocities = equilibrated(
        system, np.array(modeller.positions.value_in_unit(unit.nanometer)), temperature, seed, 500, 0.001, 100.0
    )
    return TestSystem(
        name="peptide-in-water",
        system=system,
        topology=modeller.topology,
        positions=positions,
        velocities=velocities,
        description=f"alanine dipeptide in a droplet of {waters} rigid TIP3P waters, {temperature:g} K",
        settings=ComparisonSettings(total_time=0.5, force_evaluations=500, controls=FORCE_CONTROL),
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
    start, velocities = equilibrated(system, start, temperature, seed)
    return TestSystem(
        name="polymer",
        system=system,
        topology=chain_topology(tuple(f"C{i}" for i in range(beads)), (app.element.carbon,) * beads),
        positions=start,
        velocities=velocities,
        description=f"chain of {beads} CH2 with rigid bonds, {temperature:g} K",
        settings=ComparisonSettings(total_time=2.0, force_evaluations=1000, controls=FORCE_CONTROL),
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
    positions, velocities = equilibrated(system, places, temperature, seed)
    return TestSystem(
        name="argon-cluster",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"droplet of {atoms} argon atoms, {temperature:g} K",
        settings=ComparisonSettings(total_time=20.0, force_evaluations=1000, controls=FORCE_CONTROL),
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
    positions, velocities = equilibrated(system, rigid.positions, temperature, seed, step=0.0002)
    return TestSystem(
        name="flexible-waters",
        system=system,
        topology=rigid.topology,
        positions=positions,
        velocities=velocities,
        description=f"{n} flexible TIP3P water molecules in vacuum, {temperature:g} K",
        settings=ComparisonSettings(total_time=0.5, force_evaluations=1000, controls=FORCE_CONTROL),
    )


def _openmm_data_file(name: str) -> str:
    """The path of a file among the data that ship with openmm.app."""
    return str(resources.files(app) / "data" / name)
