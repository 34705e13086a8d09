# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Constraints beyond fixed distances that are asked for most, each in one line.

>>> import openmmvrattle
>>> integrator = openmmvrattle.VariableStepRattleIntegrator(0.002)
>>> openmmvrattle.constraints.fix_angle(integrator, 3, 4, 7, 1.91)
0

Every function adds one or more expressions with `VariableStepRattleIntegrator.addConstraint()` and returns what that
returns: the index of the constraint, or a tuple of indices. With an index, `getExpressionConstraintMultiplier()` gives
the force that holds the constraint, and `setExpressionParameterValue()` changes the value at which it is held,
whose name each function gives. Lengths are in nm and angles in radians, or Quantities.

The multiplier is the generalised force along the constrained quantity q: the force on a particle is minus the
multiplier times the gradient of q. A positive multiplier pulls q to smaller values: it stands against something that
would make q larger.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import openmm
from openmm import unit

from ._arguments import array, integer, number

if TYPE_CHECKING:
    from .integrators import VariableStepRattleIntegrator

__all__ = [
    "fix_angle",
    "fix_center_of_mass",
    "fix_dihedral",
    "fix_distance",
    "fix_distance_difference",
    "fix_distance_to_point",
    "fix_to_line",
    "fix_to_plane",
    "fix_to_sphere",
]

_LENGTH, _ANGLE = unit.nanometer, unit.radian
_DISTANCE_TO_POINT = "sqrt((x1-px)^2 + (y1-py)^2 + (z1-pz)^2) - distance"
_PLANE = "nx*(x1-px) + ny*(y1-py) + nz*(z1-pz)"


def fix_distance(
    integrator: VariableStepRattleIntegrator, particle1: int, particle2: int, distance: float | unit.Quantity
) -> int:
    """Fix the distance of two particles: the parameter `distance`.

    A constraint of the System does the same and is faster. This one can be changed in the course of a run, and its
    multiplier is a force (kJ/mol/nm), the tension.
    """
    return integrator.addConstraint(
        f"{_distance(1, 2)} - distance", [particle1, particle2], {"distance": _positive(distance, "distance")}
    )


def fix_angle(
    integrator: VariableStepRattleIntegrator,
    particle1: int,
    particle2: int,
    particle3: int,
    angle: float | unit.Quantity,
) -> int:
    """Fix the angle of three particles, with the second at its corner: the parameter `angle`.

    The angle lies between 0 and pi and is neither, since there it has no direction in which to change: three particles
    that are to stay in a line are held by other expressions, which docs/constraints.md shows ("Molecules in a line").
    The multiplier is a torque (kJ/mol/rad).
    """
    value = number(angle, "angle", _ANGLE)
    if not 0 < value < math.pi:
        raise ValueError(
            f"the angle must lie between 0 and pi, and not at these, where it has no derivative: {value} does not; "
            "hold three particles in a line by the distance of the outer two and three expressions that put the middle "
            "one between them, such as x2 - 0.5*(x1+x3), likewise y and z (docs/constraints.md, molecules in a line)"
        )
    return integrator.addConstraint(
        "atan2(sqrt(cx^2 + cy^2 + cz^2), ax*bx + ay*by + az*bz) - angle;"
        "cx = ay*bz - az*by; cy = az*bx - ax*bz; cz = ax*by - ay*bx;"
        "ax = x1-x2; ay = y1-y2; az = z1-z2; bx = x3-x2; by = y3-y2; bz = z3-z2",
        [particle1, particle2, particle3],
        {"angle": value},
    )


def fix_dihedral(
    integrator: VariableStepRattleIntegrator,
    particle1: int,
    particle2: int,
    particle3: int,
    particle4: int,
    angle: float | unit.Quantity,
) -> int:
    """Fix the dihedral angle of four particles: the parameter `angle`, with the sign of OpenMM's torsion forces.

    Any angle is allowed, plus any multiple of two pi. What is held at zero is the difference from it, which jumps on
    the opposite side alone, so that there is no trouble at plus or minus pi. The multiplier is a torque (kJ/mol/rad).
    """
    return integrator.addConstraint(
        "atan2(sine*cos(angle) - cosine*sin(angle), cosine*cos(angle) + sine*sin(angle));"
        "sine = sqrt(bx^2 + by^2 + bz^2)*(ax*nx + ay*ny + az*nz); cosine = mx*nx + my*ny + mz*nz;"
        "mx = ay*bz - az*by; my = az*bx - ax*bz; mz = ax*by - ay*bx;"
        "nx = by*cz - bz*cy; ny = bz*cx - bx*cz; nz = bx*cy - by*cx;"
        "ax = x2-x1; ay = y2-y1; az = z2-z1; bx = x3-x2; by = y3-y2; bz = z3-z2; cx = x4-x3; cy = y4-y3; cz = z4-z3",
        [particle1, particle2, particle3, particle4],
        {"angle": number(angle, "angle", _ANGLE)},
    )


def fix_distance_difference(
    integrator: VariableStepRattleIntegrator,
    pair1: tuple[int, int],
    pair2: tuple[int, int],
    difference: float | unit.Quantity,
) -> int:
    """Fix the difference of two distances, that of the first pair minus that of the second: the parameter `difference`.

    The pairs may share a particle, as in the transfer of an atom from one neighbour to another. The multiplier is a
    force (kJ/mol/nm).
    """
    (a, b), (c, d) = pair1, pair2
    particles = list(dict.fromkeys((a, b, c, d)))
    if a == b or c == d or len(particles) < 3:
        raise ValueError(f"the pairs must be two different pairs of different particles, not {pair1} and {pair2}")
    places = [particles.index(particle) + 1 for particle in (a, b, c, d)]
    return integrator.addConstraint(
        f"{_distance(places[0], places[1])} - {_distance(places[2], places[3])} - difference",
        particles,
        {"difference": number(difference, "difference", _LENGTH)},
    )


def fix_distance_to_point(
    integrator: VariableStepRattleIntegrator,
    particle: int,
    point: Sequence[float] | unit.Quantity,
    distance: float | unit.Quantity,
) -> int:
    """Fix the distance of a particle from a point in space: the parameter `distance`; the point is `px`, `py`, `pz`.

    It is the pivot of a pendulum, without a particle for it. The multiplier is a force (kJ/mol/nm), the tension.
    """
    parameters = _point(point, "point") | {"distance": _positive(distance, "distance")}
    return integrator.addConstraint(_DISTANCE_TO_POINT, [particle], parameters)


def fix_to_sphere(
    integrator: VariableStepRattleIntegrator,
    particle: int,
    center: Sequence[float] | unit.Quantity,
    radius: float | unit.Quantity,
) -> int:
    """Keep a particle on a sphere: fix_distance_to_point(), with the parameter `distance` for the radius."""
    return fix_distance_to_point(integrator, particle, center, _positive(radius, "radius"))


def fix_to_plane(
    integrator: VariableStepRattleIntegrator,
    particle: int,
    point: Sequence[float] | unit.Quantity,
    normal: Sequence[float],
) -> int:
    """Keep a particle on the plane through a point with a normal, of any length.

    The parameters are the point (`px`, `py`, `pz`) and the unit normal (`nx`, `ny`, `nz`). The multiplier is the force
    (kJ/mol/nm) with which the particle presses on the plane along the normal; the plane's on the particle is the
    opposite.
    """
    n = _direction(normal, "normal")
    return integrator.addConstraint(
        _PLANE, [particle], _point(point, "point") | dict(zip(("nx", "ny", "nz"), n.tolist(), strict=True))
    )


def fix_to_line(
    integrator: VariableStepRattleIntegrator,
    particle: int,
    point: Sequence[float] | unit.Quantity,
    direction: Sequence[float],
) -> tuple[int, int]:
    """Keep a particle on the straight line through a point with a direction, as two planes at right angles."""
    along = _direction(direction, "direction")
    across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    return (
        fix_to_plane(integrator, particle, point, across.tolist()),
        fix_to_plane(integrator, particle, point, np.cross(along, across).tolist()),
    )


def fix_center_of_mass(
    integrator: VariableStepRattleIntegrator,
    system: openmm.System,
    center: Sequence[float] | unit.Quantity,
    particles: Iterable[int] | None = None,
) -> tuple[int, int, int]:
    """Fix the centre of mass of some particles, or of all: the parameter `center` of three constraints, x, y and z.

    Particles without mass are passed over. The multipliers are the components of the force (kJ/mol/nm) with which the
    particles together pull at their centre.
    """
    chosen = range(system.getNumParticles()) if particles is None else particles
    indices = [integer(i, "the index of a particle") for i in chosen]
    for index in indices:
        if not 0 <= index < system.getNumParticles():
            raise ValueError(f"there is no particle {index}; the System has {system.getNumParticles()}")
    masses = {index: system.getParticleMass(index).value_in_unit(unit.dalton) for index in indices}
    masses = {i: mass for i, mass in masses.items() if mass > 0}
    if not masses:
        raise ValueError("none of the particles has mass, so they have no centre of mass")
    total = sum(masses.values())
    parameters = _point(center, "center")
    x, y, z = (
        integrator.addConstraint(
            _sum([f"{mass / total!r}*{axis}{n + 1}" for n, mass in enumerate(masses.values())]) + " - center",
            masses,
            {"center": parameters["p" + axis]},
        )
        for axis in "xyz"
    )
    return x, y, z


def _sum(terms: list[str]) -> str:
    """A sum in pairs, pairs of pairs and so on: a plain one of thousands of terms is nested as deep."""
    if len(terms) == 1:
        return terms[0]
    half = len(terms) // 2
    return f"({_sum(terms[:half])} + {_sum(terms[half:])})"


def _distance(first: int, second: int) -> str:
    """The distance of two particles of an expression."""
    return "sqrt(" + " + ".join(f"({axis}{first}-{axis}{second})^2" for axis in "xyz") + ")"


def _positive(value: float | unit.Quantity, name: str) -> float:
    length = number(value, name, _LENGTH)
    if not length > 0:
        raise ValueError(f"the {name} must be positive, not {length}")
    return length


def _vector(value: Sequence[float] | unit.Quantity, target: unit.Unit, name: str) -> np.ndarray:
    numbers = value._value if unit.is_quantity(value) else value
    if isinstance(numbers, (str, bytes)) or not isinstance(numbers, Iterable):
        raise TypeError(f"{name} must have three components, not {value!r}")
    vector = array(value, name, target)
    if vector.shape != (3,):
        raise ValueError(f"{name} must have three components, not {len(vector)}")
    return vector


def _point(value: Sequence[float] | unit.Quantity, name: str) -> dict[str, float]:
    return dict(zip(("px", "py", "pz"), _vector(value, _LENGTH, name).tolist(), strict=True))


def _direction(value: Sequence[float], name: str) -> np.ndarray:
    vector = _vector(value, unit.dimensionless, name)
    largest = float(np.max(np.abs(vector)))
    if not 0 < largest < math.inf:
        raise ValueError(f"the {name} must be finite and not zero, not {vector.tolist()}")
    vector = vector / largest  # whose square neither overflows nor vanishes
    return vector / np.linalg.norm(vector)
