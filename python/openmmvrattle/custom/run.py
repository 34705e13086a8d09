# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What CustomVariableStepRattleIntegrator knows of its Context: how to find it, its precision, and its constraints."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import openmm

from .._constraint_errors import DistanceConstraints
from .checks import require_masses
from .settings import INSTEAD, Settings, error

LOST = 1e-3
"""A relative error of a constrained distance that no run can recover from."""


class Run:
    """What an integrator knows of its Context."""

    def __init__(self, context: openmm.Context, settings: Settings) -> None:
        self._context = weakref.ref(context)
        system, platform = context.getSystem(), context.getPlatform()
        self.platform = platform.getName()
        names = platform.getPropertyNames()
        self.keeps_variables = self.platform in ("Reference", "CPU")
        """Whether a step that ends with an exception has changed the particles, but no variable that can be read."""
        self.precision = platform.getPropertyValue(context, "Precision") if "Precision" in names else "double"
        self._refuse(system, settings)
        self.applies_default = system.getNumConstraints() == 0
        """Whether the default monitor is that of the applied force too."""
        self.good: bytes | None = None
        """A checkpoint of the last state that was looked at, since the start of the present sequence of densities."""
        self._constraints = DistanceConstraints(system)
        # Small systems are looked at often, and large ones so that it costs next to nothing.
        self._interval = int(np.clip(system.getNumParticles() / 20, 10, 500))
        self._until_check = 1
        self._largest_error = 0.0
        self._steps, self._rescues_to_tell = 0, 10

    @property
    def context(self) -> openmm.Context | None:
        return self._context()

    def _refuse(self, system: openmm.System, settings: Settings) -> None:
        require_masses(system)
        named = any(monitor.name == "ConstraintForce" and not monitor.is_default for monitor in settings.monitors)
        if named and not system.getNumConstraints():
            raise error(
                "the monitor ConstraintForce needs constraints, and the System has none: use AppliedForce or "
                "ConstraintAndAppliedForce"
            )
        if any(isinstance(force, openmm.DrudeForce) for force in system.getForces()):
            raise error("Drude particles need an integrator of their own, such as OpenMM's DrudeSCFIntegrator")
        virtual = any(system.isVirtualSite(i) for i in range(system.getNumParticles()))
        if virtual and self.platform in ("Reference", "CPU"):
            raise error(
                f"on the platform {self.platform} a CustomIntegrator computes forces from virtual sites that lag "
                f"behind by one step: use {INSTEAD} and moves virtual sites in time"
            )

    def begin(self) -> None:
        """A new sequence of densities begins, with another state: look at it soon, and forget the earlier one."""
        self.good = None
        self._until_check = 0

    def steps_to_check(self) -> int:
        return max(1, self._until_check)

    def check(self, steps: int, tolerance: float, rescues: int) -> tuple[list[str], str | None]:
        """Look from time to time how the run is doing.

        Args:
            steps: how many have been taken since this was called last.
            tolerance: that of the constraints.
            rescues: how many steps were rescued since the Context was made.

        Returns:
            What to warn the user of, each trouble once, and again when it has become ten times as large; and why the
            run cannot go on, or None.
        """
        self._until_check -= steps
        self._steps += steps
        if self._until_check > 0:
            return [], None
        self._until_check = self._interval
        message = None
        system = self.context.getSystem()
        if system.getNumConstraints() != len(self._constraints):
            self._constraints = DistanceConstraints(system)
        if len(self._constraints):
            x = positions_of(self.context)
            message, failure = self._check_constraints(x, tolerance)
            if failure is not None:
                return [], failure
            self.good = self.context.createCheckpoint()
        messages = [message, self._check_rescues(rescues, tolerance)]
        return [message for message in messages if message is not None], None

    def _check_constraints(self, x: np.ndarray, tolerance: float) -> tuple[str | None, str | None]:
        """What to warn of, and why the run cannot go on."""
        errors = self._constraints.errors(x)
        worst = int(np.argmax(errors))
        largest = float(errors[worst])
        # OpenMM's SETTLE has its distances in single precision only, whatever the tolerance.
        rounding = 1e-6
        if self.precision == "single":
            rounding += 1e-6 * float(np.max(np.abs(x)) / self._constraints.distances[worst])
        if largest < 10 * max(tolerance, rounding) or largest < 10 * self._largest_error:
            return None, None
        present = DistanceConstraints(self.context.getSystem())
        if not np.array_equal(present.distances, self._constraints.distances):  # others since Context.reinitialize()
            self._constraints = present
            return self._check_constraints(x, tolerance)
        pair = f"particles {self._constraints.first[worst]} and {self._constraints.second[worst]}"
        if not largest <= LOST:
            advice = redundant_constraints(self.context.getSystem(), x) or (
                f"use {INSTEAD} and solves strongly coupled constraints directly, or take a smaller nominal step size"
            )
            return None, (
                f"OpenMM's constraint solver has lost the distance of {pair}, by a fraction of {largest:.2g}, on the "
                f"platform {self.platform}: {advice}"
            )
        self._largest_error = largest
        return (
            f"OpenMM's constraint solver left a relative error of {largest:.1e} (tolerance {tolerance:.0e}) in the "
            f"distance of {pair} on the platform {self.platform}. Steps, their reversibility and the energy of this "
            f"run are no better than that. Use {INSTEAD} and solves strongly coupled constraints directly, or a "
            "smaller step."
        ), None

    def _check_rescues(self, rescues: int, tolerance: float) -> str | None:
        if rescues < max(self._rescues_to_tell, 0.05 * self._steps):
            return None
        self._rescues_to_tell = 10 * rescues
        return (
            f"{rescues} of {self._steps} steps had to be rescued and are not reversible: the nominal step size is too "
            "large, or the constraint forces of steps as small as these cannot be told from what the constraint "
            f"tolerance ({tolerance:.0e}) leaves. Use a smaller nominal step or tolerance, or {INSTEAD}."
        )


def redundant_constraints(system: openmm.System, positions: np.ndarray) -> str | None:
    """A sentence that names constraints that are not independent of each other, or None if there are none.

    Of each cluster of constraints the eigenvalues of G M^-1 G^T, whose rows have length 1 in this metric. Clusters of
    more than a thousand are passed over.
    """
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    inverse_masses = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    pairs = [system.getConstraintParameters(i)[:2] for i in range(system.getNumConstraints())]
    for cluster in _clusters(pairs):
        if not 1 < len(cluster) <= 1000:
            continue
        particles = sorted({particle for k in cluster for particle in pairs[k]})
        place = {particle: i for i, particle in enumerate(particles)}
        rows = np.zeros((len(cluster), len(particles), 3))
        for row, k in zip(rows, cluster, strict=True):
            i, j = pairs[k]
            row[place[i]] = positions[i] - positions[j]
            row[place[j]] = positions[j] - positions[i]
        rows = (rows * np.sqrt(inverse_masses[particles])[None, :, None]).reshape(len(cluster), -1)
        lengths = np.linalg.norm(rows, axis=1)
        if not np.all(lengths > 0):  # nan too
            continue
        rows /= lengths[:, None]
        if np.linalg.eigvalsh(rows @ rows.T)[0] < 1e-10:
            names = [str(particle) for particle in particles]
            return (
                f"the constraints among the particles {', '.join(names[:-1])} and {names[-1]} are redundant or nearly "
                "so in the current configuration; remove one of them if they are so in every configuration"
            )
    return None


def _clusters(pairs: list[tuple[int, int]]) -> list[list[int]]:
    """The constraints that are joined by particles, as lists of their indices."""
    parent: dict[int, int] = {}

    def root(particle: int) -> int:
        parent.setdefault(particle, particle)
        while parent[particle] != particle:
            parent[particle] = parent[parent[particle]]
            particle = parent[particle]
        return particle

    for first, second in pairs:
        parent[root(first)] = root(second)
    clusters: dict[int, list[int]] = {}
    for k, (first, _) in enumerate(pairs):
        clusters.setdefault(root(first), []).append(k)
    return list(clusters.values())


def find_context(integrator: openmm.Integrator) -> openmm.Context | None:
    """The Context that an integrator is bound to, or None if it is not found.

    In Python OpenMM tells an integrator nothing of its Context: Context.__init__ hands the C++ objects over and keeps
    the integrator, and that is all. Nothing of ours is called then, no method of an integrator leads to the Context,
    and its program can hold numbers alone; while its platform, its time and its constraints are needed from the first
    step on. So the first step(), stepTo(), reverse() or calibrate() with a Context looks for the one that refers to
    the integrator; later ones know it, and so do those after attachContext().
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
