# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The settings of CustomVariableStepRattleIntegrator, and the checks of what a user gives for them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import openmm
from openmm import unit

from .._arguments import number

PREFIX = "vrattle_"
VERSION = 2
SEMI_EXPLICIT, EXPLICIT, BOUNDED = 0, 1, 2
MONITOR_KINDS = (
    "ConstraintMultipliers",
    "ConstraintForce",
    "AppliedForce",
    "ConstraintAndAppliedForce",
    "MultiplierPNorm",
    "ForcePNorm",
    "VectorField",
    "MaxForce",
    "ArcLength",
    "MaxParticleArcLength",
    "ForceGroupEnergy",
)
"""The kinds of monitor by their numbers, the same as of VariableStepRattleIntegrator."""


INSTEAD = "VariableStepRattleIntegrator, which runs on every platform"
REFUSED_MONITORS = {
    "ConstraintMultipliers": "needs the constraints' multipliers, which OpenMM does not tell: use ConstraintForce",
    "MultiplierPNorm": "needs the constraints' multipliers, which OpenMM does not tell: use ConstraintForce",
    "MaxForce": "needs a maximum over particles, and a CustomIntegrator can only add up: use ForcePNorm",
    "MaxParticleArcLength": "needs a maximum over particles, and a CustomIntegrator can only add up: use ArcLength",
}


@dataclass
class Monitor:
    """One monitor: its kind, weight and power, and the reference value that was set (0: from the first step)."""

    kind: int
    weight: float = 1.0
    power: float = 1.0
    reference: float = 0.0
    is_default: bool = False
    """Whether nobody has named it: then it is that of the applied force too, where there are no constraints."""

    @property
    def name(self) -> str:
        return MONITOR_KINDS[self.kind]


@dataclass
class Settings:
    """Every setting of the integrator. A bound of -1 stands for the default, which follows the nominal step."""

    nominal: float
    minimum: float = -1.0
    maximum: float = -1.0
    update: int = SEMI_EXPLICIT
    monitors: list[Monitor] = field(
        default_factory=lambda: [Monitor(MONITOR_KINDS.index("ConstraintForce"), is_default=True)]
    )
    order: float = 8.0
    group: int = 31
    tolerance_set: bool = False

    @property
    def minimum_in_force(self) -> float:
        return self.nominal / 50 if self.minimum < 0 else self.minimum

    @property
    def maximum_in_force(self) -> float:
        return 2 * self.nominal if self.maximum < 0 else self.maximum

    def uses(self, *names: str) -> bool:
        """Whether one of the monitors is of one of these kinds."""
        return any(monitor.name in names for monitor in self.monitors)

    @property
    def has_default(self) -> bool:
        """Whether the monitor that nobody has named is in use."""
        return any(monitor.is_default for monitor in self.monitors)

    @property
    def uses_constraint_force(self) -> bool:
        return self.uses("ConstraintForce", "ConstraintAndAppliedForce")

    @property
    def uses_velocities(self) -> bool:
        return self.uses("VectorField", "ArcLength")

    @property
    def is_iterative(self) -> bool:
        """Whether the next density depends on the constraint forces or velocities of the step that it belongs to."""
        return self.uses_constraint_force or (self.update == SEMI_EXPLICIT and self.uses_velocities)

    def globals(self) -> dict[str, float]:
        """The settings as global variables of a CustomIntegrator: what a copy of the integrator is made from."""
        result = {
            "version": float(VERSION),
            "nominalStep": self.nominal,
            "minimumStep": self.minimum,
            "maximumStep": self.maximum,
            "updateMethod": float(self.update),
            "normOrder": self.order,
            "energyGroup": float(self.group),
            "toleranceSet": float(self.tolerance_set),
            "monitors": float(len(self.monitors)),
            "conflict": float(self.conflict() is not None),
        }
        for k, monitor in enumerate(self.monitors):
            result[f"kind{k}"] = float(monitor.kind)
            result[f"weight{k}"] = monitor.weight
            result[f"power{k}"] = monitor.power
            result[f"setReference{k}"] = monitor.reference
            result[f"default{k}"] = float(monitor.is_default)
        return result | self.bounds()

    @staticmethod
    def from_globals(values: dict[str, float]) -> Settings:
        """The settings from the global variables."""
        return Settings(
            nominal=values["nominalStep"],
            minimum=values["minimumStep"],
            maximum=values["maximumStep"],
            update=int(values["updateMethod"]),
            monitors=[
                Monitor(
                    int(values[f"kind{k}"]),
                    values[f"weight{k}"],
                    values[f"power{k}"],
                    values[f"setReference{k}"],
                    bool(values[f"default{k}"]),
                )
                for k in range(int(values["monitors"]))
            ],
            order=values["normOrder"],
            group=int(values["energyGroup"]),
            tolerance_set=bool(values["toleranceSet"]),
        )

    def conflict(self) -> str | None:
        """Why no step can be taken with this nominal step and these bounds, or None if there is no reason."""
        if self.nominal == 0:
            return "no step can be taken with the nominal step size 0, which is for a Context that computes energies"
        low, high = self.minimum_in_force, self.maximum_in_force
        if (low == 0 or low < self.nominal) and (high == 0 or self.nominal < high):
            return None
        return (
            "the nominal step size must be larger than the minimum and smaller than the maximum one: the minimum is "
            f"{low:g} ps, the nominal one {self.nominal:g} ps and the maximum {high:g} ps (0: no bound)"
        )

    def bounds(self) -> dict[str, float]:
        """What the Moebius function B of docs/method.md, section 6, is computed from, and the a of the bounded
        update."""
        maximum = self.maximum_in_force if self.conflict() is None else 0.0
        minimum = self.minimum_in_force if self.conflict() is None else 0.0
        a = self.nominal / maximum if maximum > 0 else 0.0
        lower = min(4 * a / 3, (1 + 2 * a) / 3) if self.update == BOUNDED else a
        if minimum > 0:
            upper = self.nominal / minimum
            curvature = (1 - lower) / (upper - 1)
            slope = upper * curvature
        else:
            upper, curvature, slope = 16.0, 0.0, 1 - lower
        return {
            "smallestDensity": a,
            "boundOffset": lower,
            "boundSlope": slope,
            "boundCurvature": curvature,
            # The first guess of a start with known reference values: the density of short steps.
            "startDensity": upper,
        }


def density_of(settings: Settings, values: dict[str, float], name: str) -> float:
    """u = B(U_rel) from values U_k that have a name in the program."""
    total = weights = 0.0
    for k, monitor in enumerate(settings.monitors):
        reference = values[f"reference{k}"]
        relative = (values[f"{name}{k}"] / reference) ** monitor.power if reference > 0 else 1.0
        total += (monitor.weight * relative) ** 2
        weights += monitor.weight**2
    relative = math.sqrt(total / weights)
    bounds = settings.bounds()
    return (bounds["boundOffset"] + bounds["boundSlope"] * relative) / (1 + bounds["boundCurvature"] * relative)


def check(settings: Settings) -> None:
    """Raise an OpenMMException if update and monitors do not fit together."""
    if settings.update == EXPLICIT and settings.uses_constraint_force:
        raise error(
            "the update Explicit needs the constraint force before the step is taken, which a CustomIntegrator does "
            f"not know: take SemiExplicit or Bounded, or a monitor without constraint force, or {INSTEAD}"
        )


def error(message: str) -> openmm.OpenMMException:
    return openmm.OpenMMException(f"CustomVariableStepRattleIntegrator: {message}")


def positive(value: float, name: str, unit_name: str = "") -> float:
    if not (math.isfinite(value) and value > 0):
        raise error(f"{name} must be positive and finite, not {value:g}{' ' + unit_name if unit_name else ''}")
    return value


def step_size(size: float | unit.Quantity, name: str) -> float:
    """A nominal step size in ps; 0 for a Context that computes energies alone."""
    value = number(size, name, unit.picosecond)
    if not (math.isfinite(value) and value >= 0):
        raise error(f"the nominal step size must be positive and finite, or 0 to take no steps, not {value:g} ps")
    return value


def bound(size: float | unit.Quantity, name: str) -> float:
    value = number(size, "size", unit.picosecond)
    if not (math.isfinite(value) and value >= 0):
        raise error(f"the {name} step size must be positive, or 0 for none, not {value:g} ps")
    return value
