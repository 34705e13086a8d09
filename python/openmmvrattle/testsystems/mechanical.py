# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Pendulums and whips: chains of few or many rigid bonds without other structure."""

from __future__ import annotations

import math

import numpy as np
import openmm
from openmm import app

from .base import (
    FORCE_CONTROL,
    ComparisonSettings,
    MonitorSettings,
    StepControl,
    TestSystem,
    chain_topology,
    project_onto_constraints,
    thermal_velocities,
)


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
        topology=chain_topology(("pivot", "inner", "outer")),
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
        topology=chain_topology(("I1", "H", "I2"), (app.element.iodine, app.element.hydrogen, app.element.iodine)),
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
    positions, velocities = thermal_velocities(system, np.array(positions), temperature, random)
    elements = tuple(app.element.iodine if i % 2 == 0 else app.element.hydrogen for i in range(atoms))
    return TestSystem(
        name="long-light-heavy-chain",
        system=system,
        topology=chain_topology(tuple(f"A{i}" for i in range(atoms)), elements),
        positions=positions,
        velocities=velocities,
        description=f"chain of {atoms} I and H by turns, rigid bonds, {temperature:g} K",
        settings=ComparisonSettings(total_time=10.0, force_evaluations=8000, controls=FORCE_CONTROL),
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
    positions, velocities = thermal_velocities(system, np.array(positions), temperature, random)
    return TestSystem(
        name="independent-whips",
        system=system,
        topology=topology,
        positions=positions,
        velocities=velocities,
        description=f"{molecules} I-CH2-I with rigid bonds that do not see each other, {temperature:g} K",
        settings=ComparisonSettings(total_time=5.0, force_evaluations=2000, controls=FORCE_CONTROL),
    )
