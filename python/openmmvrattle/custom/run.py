# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What CustomVariableStepRattleIntegrator knows of its Context: how to find it, its precision, and its constraints."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import openmm
from openmm import unit

from .settings import INSTEAD, error

LOST = 1e-3
"""A relative error of a constrained distance that no run can recover from."""


class Run:
    """What an integrator knows of its Context."""

    def __init__(self, context: openmm.Context) -> None:
        self._context = weakref.ref(context)
        system, platform = context.getSystem(), context.getPlatform()
        self.platform = platform.getName()
        names = platform.getPropertyNames()
        self.precision = platform.getPropertyValue(context, "Precision") if "Precision" in names else "double"
        self._refuse(system)
        constraints = [system.getConstraintParameters(i) for i in range(system.getNumConstraints())]
        self._first = np.array([c[0] for c in constraints], dtype=int)
        self._second = np.array([c[1] for c in constraints], dtype=int)
        self._distances = np.array([c[2].value_in_unit(unit.nanometer) for c in constraints])
        # Small systems are looked at often, and large ones so that it costs next to nothing.
        self._interval = int(np.clip(system.getNumParticles() / 20, 10, 500))
        self._until_check = 1
        self._largest_error = 0.0
        self._steps, self._rescues_to_tell = 0, 10

    @property
    def context(self) -> openmm.Context | None:
        return self._context()

    def _refuse(self, system: openmm.System) -> None:
        if any(isinstance(force, openmm.DrudeForce) for force in system.getForces()):
            raise error("Drude particles need an integrator of their own, such as OpenMM's DrudeSCFIntegrator")
        virtual = any(system.isVirtualSite(i) for i in range(system.getNumParticles()))
        if virtual and self.platform in ("Reference", "CPU"):
            raise error(
                f"on the platform {self.platform} a CustomIntegrator computes forces from virtual sites that lag "
                f"behind by one step: use {INSTEAD} and moves virtual sites in time"
            )

    def speed(self) -> float:
        """The mass-weighted norm of the velocities, whose square is twice the kinetic energy."""
        system = self.context.getSystem()
        masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
        return float(np.linalg.norm(np.sqrt(masses)[:, None] * velocities_of(self.context)))

    def steps_to_check(self) -> int:
        return max(1, self._until_check)

    def check(self, steps: int, tolerance: float, rescues: int) -> list[str]:
        """Look from time to time how the run is doing.

        Args:
            steps: how many have been taken since this was called last.
            tolerance: that of the constraints.
            rescues: how many steps were rescued since the Context was made.

        Returns:
            What to warn the user of; each trouble once, and again when it has become ten times as large.
        """
        self._until_check -= steps
        self._steps += steps
        if self._until_check > 0:
            return []
        self._until_check = self._interval
        messages = [self._check_constraints(tolerance), self._check_rescues(rescues, tolerance)]
        return [message for message in messages if message is not None]

    def _check_constraints(self, tolerance: float) -> str | None:
        if not len(self._distances):
            return None
        x = positions_of(self.context)
        errors = np.abs(np.linalg.norm(x[self._first] - x[self._second], axis=1) / self._distances - 1)
        worst = int(np.argmax(errors))
        largest = float(errors[worst])
        # OpenMM's SETTLE has its distances in single precision only, whatever the tolerance.
        rounding = 1e-6
        if self.precision == "single":
            rounding += 1e-6 * float(np.max(np.abs(x)) / self._distances[worst])
        if largest < 10 * max(tolerance, rounding) or largest < 10 * self._largest_error:
            return None
        self._largest_error = largest
        pair = f"particles {self._first[worst]} and {self._second[worst]}"
        if not largest <= LOST:
            raise error(
                f"OpenMM's constraint solver has lost the distance of {pair}, by a fraction of {largest:.2g}, on the "
                f"platform {self.platform}: go back to a saved state and use {INSTEAD} and solves strongly coupled "
                "constraints directly, or take a smaller nominal step size"
            )
        return (
            f"OpenMM's constraint solver left a relative error of {largest:.1e} (tolerance {tolerance:.0e}) in the "
            f"distance of {pair} on the platform {self.platform}. Steps, their reversibility and the energy of this "
            f"run are no better than that. Use {INSTEAD} and solves strongly coupled constraints directly, or a "
            "smaller step."
        )

    def _check_rescues(self, rescues: int, tolerance: float) -> str | None:
        if rescues < max(self._rescues_to_tell, 0.05 * self._steps):
            return None
        self._rescues_to_tell = 10 * rescues
        return (
            f"{rescues} of {self._steps} steps had to be rescued and are not reversible: the nominal step size is too "
            "large, or the constraint forces of steps as small as these cannot be told from what the constraint "
            f"tolerance ({tolerance:.0e}) leaves. Use a smaller nominal step or tolerance, or {INSTEAD}."
        )


def find_context(integrator: openmm.Integrator) -> openmm.Context | None:
    """The Context that an integrator is bound to.

    In Python OpenMM tells an integrator nothing of its Context, so look for the one that refers to it, once for each.
    """
    for referrer in gc.get_referrers(integrator):
        owners = [referrer] if not isinstance(referrer, dict) else gc.get_referrers(referrer)
        for owner in owners:
            if isinstance(owner, openmm.Context) and owner.__dict__.get("_integrator") is integrator:
                return owner
    return None


def positions_of(context: openmm.Context) -> np.ndarray:
    return context.getState(positions=True).getPositions(asNumpy=True)._value


def velocities_of(context: openmm.Context) -> np.ndarray:
    return context.getState(velocities=True).getVelocities(asNumpy=True)._value


def vectors(values: np.ndarray) -> list[openmm.Vec3]:
    return [openmm.Vec3(*row) for row in values]
