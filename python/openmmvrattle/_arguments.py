# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What users give as arguments: numbers or Quantities, checked and without their units."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import openmm
from openmm import unit


def number(value: object, name: str, target: unit.Unit = unit.dimensionless) -> float:
    """Return `value`, a number or a Quantity, as a number in the unit `target`."""
    wanted = "a plain number" if target is unit.dimensionless else f"a number or a Quantity in {target.get_name()}s"
    if unit.is_quantity(value):
        if not value.unit.is_compatible(target):
            raise TypeError(f"{name} must be {wanted}, not a Quantity in {value.unit.get_name()}")
        value = value.value_in_unit(target)
    try:
        if isinstance(value, (str, bytes)):  # float() would read these
            raise TypeError
        return float(value)
    except TypeError:
        raise TypeError(f"{name} must be {wanted}, not {value!r}") from None
    except OverflowError:
        raise openmm.OpenMMException(f"{name} is an integer too large for a number") from None


_LARGEST = 2**31 - 1  # that C++ takes
PARAMETER_NAME = "the name of a parameter"


def integer(value: object, name: str, largest: int = _LARGEST) -> int:
    """Return `value` as an int, if it is an integer of any kind that C++ can take."""
    try:
        result = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be an integer, not {value!r}") from None
    if not -_LARGEST - 1 <= result <= largest:
        raise openmm.OpenMMException(f"{name} must be an integer from {-_LARGEST - 1} to {largest}, not {result}")
    return result


def boolean(value: object, name: str) -> bool:
    """Return `value`, True or False of any kind, as a bool."""
    if not isinstance(value, (int, np.bool_)) or value not in (0, 1):
        raise TypeError(f"{name} must be True or False, not {value!r}")
    return bool(value)


def string(value: object, name: str) -> str:
    """Return `value`, if it is a string."""
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a string, not {value!r}")
    return value


def parameter(value: object, name: str) -> float:
    """Return `value`, a number or a Quantity of any dimension, as a number in OpenMM's unit system."""
    if unit.is_quantity(value):
        value = value.value_in_unit_system(unit.md_unit_system)
    return number(value, f"the parameter {name}")


def array(value: Any, name: str, target: unit.Unit) -> np.ndarray:
    """Return `value`, numbers or Quantities in any arrangement, as an array in the unit `target`."""
    if unit.is_quantity(value):
        if not value.unit.is_compatible(target):
            wanted = "plain numbers" if target is unit.dimensionless else f"in {target.get_name()}s"
            raise TypeError(f"{name} must be {wanted}, not in {value.unit.get_name()}")
        value = value.value_in_unit(target)
    if isinstance(value, np.ndarray):
        return np.array(value, dtype=float)
    return np.array([array(x, name, target) if _has_parts(x) else number(x, name, target) for x in value])


def _has_parts(value: Any) -> bool:
    return np.ndim(value._value if unit.is_quantity(value) else value) > 0


def plain(value: Any, target: unit.Unit) -> Any:
    """Return what OpenMM has returned, a Quantity or a plain number or array, in the unit `target`."""
    return value.value_in_unit(target) if unit.is_quantity(value) else value


def constraint_arguments(
    expression: object, particles: object, parameters: object
) -> tuple[str, list[int], dict[str, float]]:
    """Return the expression, the particles, and the values of the parameters of a constraint."""
    if isinstance(particles, (str, bytes, unit.Quantity)) or not isinstance(particles, Iterable):
        raise TypeError(f"particles must be a list of integers, not {particles!r}")
    if not isinstance(parameters, Mapping):
        raise TypeError(f"parameters must be a dict of names and values, not {parameters!r}")
    return (
        string(expression, "expression"),
        [integer(particle, "the index of a particle") for particle in particles],
        {string(name, PARAMETER_NAME): parameter(value, name) for name, value in parameters.items()},
    )


def monitor_arguments(monitors: object) -> list[Sequence[Any]]:
    """Return the arguments of addMonitor() for each of a list of kinds, or tuples of a kind, a weight and so on."""
    if not isinstance(monitors, (list, tuple)):
        raise TypeError(f"monitors must be a list of kinds or (kind, weight, power) tuples, not {monitors!r}")
    return [monitor if isinstance(monitor, (list, tuple)) else (monitor,) for monitor in monitors]
