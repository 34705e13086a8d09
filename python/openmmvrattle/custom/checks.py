# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What CustomVariableStepRattleIntegrator refuses, since a run would go wrong without a word: Systems and states."""

from __future__ import annotations

import itertools

import numpy as np
import openmm

from .._constraint_errors import DistanceConstraints
from .settings import error

_MAX_SPEED = 1e6
"""Three times the speed of light, in nm/ps."""
_MET_FRACTION, _MET_DISTANCE = 0.1, 0.03
"""A constrained distance counts as met to this fraction, and no worse than to this distance (nm)."""


def require_masses(system: openmm.System) -> None:
    """Refuse masses that are negative or no numbers."""
    for i in range(system.getNumParticles()):
        mass = system.getParticleMass(i)._value
        if not (mass >= 0 and np.isfinite(mass)):
            raise error(
                f"the mass of particle {i} is {mass:g} amu, and masses are positive, or 0 for a particle that does not "
                "move; correct it with setParticleMass() of the System"
            )


def require_sound_start(context: openmm.Context) -> None:
    """Refuse a state that is no start for a run, before its positions are moved onto the constraints."""
    system, state = context.getSystem(), context.getState(positions=True, velocities=True)
    positions, velocities = (
        values._value for values in (state.getPositions(asNumpy=True), state.getVelocities(asNumpy=True))
    )
    for i in np.flatnonzero(~np.isfinite(positions).all(axis=1)):
        if not system.isVirtualSite(int(i)):
            raise error(f"the position of particle {i} is not a finite number; set it before stepping")
    for i in np.flatnonzero(~(np.linalg.norm(velocities, axis=1) <= _MAX_SPEED)):
        if system.getParticleMass(int(i))._value > 0:
            speed = np.linalg.norm(velocities[i])
            what = f"{speed:g} nm/ps, faster than light" if np.isfinite(speed) else "not a finite number"
            raise error(
                f"the velocity of particle {i} is {what}; setVelocitiesToTemperature() of the Context, which uses "
                "OpenMM's own constraint solver, can leave velocities so where constraints are strongly coupled, and "
                "that of VariableStepRattleIntegrator does not"
            )
    box = state.getPeriodicBoxVectors(asNumpy=True)._value
    if system.getNumConstraints() and (_uses_box(system) or np.any(box != 2 * np.eye(3))):
        _require_whole_molecules(system, positions, box)


def explain_not_finite(context: openmm.Context) -> str:
    """What of a state is not finite, by the first particle."""
    system, state = context.getSystem(), context.getState(positions=True, velocities=True)
    for name, values in (
        ("position", state.getPositions(asNumpy=True)._value),
        ("velocity", state.getVelocities(asNumpy=True)._value),
    ):
        for i in np.flatnonzero(~np.isfinite(values).all(axis=1)):
            if system.getParticleMass(int(i))._value > 0:
                return f"the {name} of particle {i} is not a finite number: set another"
    return f"forces are not finite, and {explain_largest_force(context)}; move apart what overlaps"


def explain_largest_force(context: openmm.Context, groups: int = -1) -> str:
    """Which particle the largest force acts on, where overlaps are to be looked for."""
    try:
        forces = context.getState(forces=True, groups=groups).getForces(asNumpy=True)._value
    except openmm.OpenMMException as failure:  # of a platform that looks for what is no number
        return str(failure)
    infinite = np.flatnonzero(~np.isfinite(forces).all(axis=1))
    if len(infinite):
        return f"the force on particle {infinite[0]} is infinite or not a number"
    sizes = np.linalg.norm(forces, axis=1)
    return f"the largest force there, {np.max(sizes):.2g} kJ/mol/nm, is on particle {np.argmax(sizes)}"


def _uses_box(system: openmm.System) -> bool:
    try:
        return bool(system.usesPeriodicBoundaryConditions())
    except openmm.OpenMMException:  # of a Force that does not tell
        return False


def _require_whole_molecules(system: openmm.System, positions: np.ndarray, box: np.ndarray) -> None:
    """Refuse constraints that are missed, and met by the nearest periodic image."""
    constraints = DistanceConstraints(system)
    lengths = constraints.distances
    r = positions[constraints.first] - positions[constraints.second]
    allowed = np.minimum(_MET_FRACTION * lengths, _MET_DISTANCE)
    distances = np.linalg.norm(r, axis=1)
    missed = np.flatnonzero(np.abs(distances - lengths) > allowed)
    image = r[missed]
    for axis in (2, 1, 0):
        image = image - np.round(image[:, axis, None] / box[axis, axis]) * box[axis]
    shifts = np.array(list(itertools.product((-1, 0, 1), repeat=3))) @ box
    nearest = np.linalg.norm(image[:, None, :] + shifts, axis=2).min(axis=1)
    for k, distance in zip(missed, nearest, strict=True):
        if abs(distance - lengths[k]) <= allowed[k]:
            pair = f"the particles {constraints.first[k]} and {constraints.second[k]}"
            raise error(
                f"the constrained distance between {pair} is {distances[k]:g} nm, and to the nearest periodic image "
                f"{distance:g} nm, which meets the length of {lengths[k]:g} nm: molecules must be whole, and this one "
                "is not; add box vectors to positions until each molecule is in one piece, as programs that make "
                "molecules whole do"
            )
