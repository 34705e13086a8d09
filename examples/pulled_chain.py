# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The tension along a chain that is pulled, read from the Lagrange multipliers, against statics.

A chain of rigid bonds hangs from a fixed point in gravity, and its end is pulled sideways. At rest the tension of a
bond is the size of the force that holds up what lies below it: the weight of those beads and the pull. The multiplier
of the constraint |r|^2 - d^2 = 0 is half the tension over the length of the bond. On Reference both agree to 1e-12.

    python examples/pulled_chain.py [--platform NAME] [--precision NAME]
"""

from __future__ import annotations

import numpy as np
import openmm
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.platforms import command_line_platform

BEADS, LENGTH, MASS = 10, 0.15, 14.0  # nm, amu
GRAVITY, PULL = 10.0, 500.0  # nm/ps^2, kJ/mol/nm


def statics() -> tuple[np.ndarray, np.ndarray]:
    """The positions at rest (nm) and the tension of each bond (kJ/mol/nm), from the balance of forces alone."""
    below = BEADS - np.arange(BEADS)  # the beads that hang on bond k
    force = np.stack([np.full(BEADS, PULL), -GRAVITY * MASS * below], axis=1)
    tension = np.linalg.norm(force, axis=1)
    steps = LENGTH * force / tension[:, None]
    positions = np.zeros((BEADS + 1, 3))
    positions[1:, :2] = np.cumsum(steps, axis=0)
    return positions, tension


def tensions_from_multipliers(platform: openmm.Platform, properties: dict[str, str]) -> np.ndarray:
    """The same tensions from getMultipliers(), at the state of rest."""
    system = openmm.System()
    system.addParticle(1e15)  # the point of suspension: as good as fixed
    for _ in range(BEADS):
        system.addParticle(MASS)
    for k in range(BEADS):
        system.addConstraint(k, k + 1, LENGTH)
    weight = openmm.CustomExternalForce(f"{GRAVITY * MASS}*y")
    for bead in range(1, BEADS + 1):
        weight.addParticle(bead)
    pull = openmm.CustomExternalForce(f"-{PULL}*x")
    pull.addParticle(BEADS)
    system.addForce(weight)
    system.addForce(pull)
    integrator = VariableStepRattleIntegrator(0.001)
    context = openmm.Context(system, integrator, platform, properties)
    context.setPositions(statics()[0])
    multipliers = integrator.getMultipliers().value_in_unit(unit.kilojoule_per_mole / unit.nanometer**2)
    return 2 * np.array(multipliers) * LENGTH


def main() -> None:
    """Print both side by side."""
    _, expected = statics()
    found = tensions_from_multipliers(*command_line_platform("Reference"))
    print("bond  tension from statics  from the multipliers (kJ/mol/nm)")
    for k, (a, b) in enumerate(zip(expected, found, strict=True)):
        print(f"{k:4d}  {a:20.6f}  {b:20.6f}")
    print(f"largest relative difference: {np.max(np.abs(found / expected - 1)):.1e}")


if __name__ == "__main__":
    main()
