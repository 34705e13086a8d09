# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The elastic rod of section 5 of the paper, which has constraints that are expressions."""

from __future__ import annotations

import functools
import math

import numpy as np
import openmm
from openmm import app

from .base import ComparisonSettings, ExpressionConstraint, MonitorSettings, StepControl, TestSystem

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
