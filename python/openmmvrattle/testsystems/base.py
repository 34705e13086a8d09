# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""What a test system is made of, and what the systems share: step controls, thermal starts, projection."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import openmm
from openmm import app, unit

from .._constraint_errors import ConstraintErrors, DistanceConstraints


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
    automatic: bool = False
    """Automatic step control, which takes the place of monitors, bounds and update."""

    @property
    def label(self) -> str:
        """A short name for tables and pictures."""
        if self.automatic:
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


COLLISION_CONTROL = StepControl(
    monitors=(MonitorSettings("ForcePNorm", power=0.5),), nominal_step_size=1e-3, update_method="Explicit"
)


MOLECULAR_CONTROLS = (
    StepControl(monitors=(MonitorSettings("ConstraintMultipliers"),), nominal_step_size=1e-3),
    StepControl(monitors=(MonitorSettings("ConstraintAndAppliedForce"),), nominal_step_size=1e-3),
)


FORCE_CONTROL = (StepControl(monitors=(MonitorSettings("ConstraintAndAppliedForce"),), nominal_step_size=1e-3),)


_BOLTZMANN = 0.00831446261815324  # kJ/mol/K


def thermal_velocities(
    system: openmm.System, positions: np.ndarray, temperature: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Positions on the constraints, and velocities of the Maxwell-Boltzmann distribution that are tangent to them."""
    masses = np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])
    # Drawn for free particles and projected in the mass metric, they have the distribution of the constrained ones.
    velocities = random.standard_normal(positions.shape) * np.sqrt(_BOLTZMANN * temperature / masses)[:, None]
    return project_onto_constraints(system, positions, velocities)


def constraint_error(system: openmm.System, positions: np.ndarray) -> float:
    """The largest relative error of a constrained distance; 0 for a system without constraints.

    Args:
        system: the system whose constraints are checked.
        positions: positions in nm, one row for each particle.
    """
    return ConstraintErrors(system).largest(positions)


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
    constraints = DistanceConstraints(system)
    first, second, distances = constraints.first, constraints.second, constraints.distances
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


def equilibrated(
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


def chain_topology(names: tuple[str, ...], elements: tuple[Any, ...] | None = None) -> app.Topology:
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
