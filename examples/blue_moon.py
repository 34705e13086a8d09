# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""A free energy from the multiplier of a fixed reaction coordinate (the blue-moon ensemble), against the known one.

Two particles at a distance r attract each other, and a third one is held by a spring that gets stiffer with r. Then
the free energy along r is known: F(r) = V(r) + (3/2) n kT ln r - 2 kT ln r, with the spring's entropy and that of the
directions of r. With r held by a constraint, the mean of its multiplier is the mean force: dF/dr = -<Lambda>. There is
no other term, as for a distance 1/m1 + 1/m2 is constant (Carter, Ciccotti, Hynes and Kapral, Chem. Phys. Lett. 156
(1989) 472). The scan needs one Context: each r is a new value of the constraint's parameter. What is found lies within
two or three standard errors of what is known.

    python examples/blue_moon.py [--platform NAME] [--precision NAME]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import openmm
from openmm import unit
from openmmvrattle import VariableStepRattleIntegrator, constraints
from openmmvrattle.platforms import command_line_platform

TEMPERATURE = 300.0  # K
KT = unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin) * TEMPERATURE
WELL, REST = 100.0, 0.3  # kJ/mol/nm^2, nm: the pair's own potential is WELL/2 (r - REST)^2
SPRING, POWER = 500.0, 4  # kJ/mol/nm^2: the spring on the third is SPRING (r/REST)^POWER
MASSES = (12.0, 20.0, 10.0)  # amu
STEP, STEPS_TO_SAMPLE = 0.01, 5  # ps
# Windows of one length could be half a period of a vibration, whose energy would then never be exchanged.
SAMPLES_IN_WINDOW = (2, 9)
DISTANCES = (0.22, 0.26, 0.30, 0.34, 0.38)  # nm


@dataclass
class MeanForce:
    """dF/dr at a distance (kJ/mol/nm), with its standard error."""

    distance: float
    value: float
    error: float


def known_mean_force(distance: float) -> float:
    """dF/dr from the integral over everything but r."""
    return WELL * (distance - REST) + (1.5 * POWER - 2) * KT / distance


def make_context(
    copies: int, seed: int, platform: openmm.Platform, properties: dict[str, str]
) -> tuple[VariableStepRattleIntegrator, openmm.Context]:
    """Independent copies side by side: their constraints share an expression and are evaluated together."""
    system = openmm.System()
    energy = f"{WELL / 2}*(r-{REST})^2 + {SPRING / 2}*(r/{REST})^{POWER}*(x3^2+y3^2+z3^2); r = distance(p1,p2)"
    force = openmm.CustomCompoundBondForce(3, energy)
    system.addForce(force)
    # With a thermostat that sets velocities anew there is nothing to gain from variable steps. With them, averages over
    # the steps have to be weighted with the step sizes.
    integrator = VariableStepRattleIntegrator(STEP, monitors=[])
    for copy in range(copies):
        for mass in MASSES:
            system.addParticle(mass)
        force.addBond([3 * copy, 3 * copy + 1, 3 * copy + 2], [])
        constraints.fix_distance(integrator, 3 * copy, 3 * copy + 1, DISTANCES[0])
    context = openmm.Context(system, integrator, platform, properties)
    random = np.random.default_rng(seed)
    positions = np.zeros((copies, 3, 3))
    positions[:, 1] = random.normal(size=(copies, 3))
    # The spring is in equilibrium from the start.
    width = np.sqrt(KT / (SPRING * (DISTANCES[0] / REST) ** POWER))
    positions[:, 2] = width * random.normal(size=(copies, 3))
    context.setPositions(positions.reshape(-1, 3))
    return integrator, context


def scan(
    platform: openmm.Platform, properties: dict[str, str], copies: int = 200, windows: int = 40, seed: int = 1
) -> list[MeanForce]:
    """The mean force at every distance, from copies times windows stretches with fresh velocities."""
    integrator, context = make_context(copies, seed, platform, properties)
    random = np.random.default_rng(seed)
    results = []
    for n, distance in enumerate(DISTANCES):
        for copy in range(copies):
            integrator.setExpressionParameterValue(copy, "distance", distance)
        samples = []
        for window in range(windows):
            # OpenMM knows nothing of our constraints; the integrator makes these velocities tangent, in the metric of
            # the masses, which is what the constrained Maxwell distribution needs.
            context.setVelocitiesToTemperature(TEMPERATURE, 1 + seed * 1000003 + n * windows + window)
            for _ in range(random.integers(*SAMPLES_IN_WINDOW)):
                integrator.step(STEPS_TO_SAMPLE)
                if window < windows // 4:
                    continue  # to forget the last distance
                multipliers = integrator.getMultipliers()
                samples.append(multipliers.value_in_unit(multipliers.unit))
        forces = -np.mean(samples, axis=0)  # of each copy
        results.append(MeanForce(distance, float(np.mean(forces)), float(np.std(forces, ddof=1) / np.sqrt(copies))))
    return results


def main() -> None:
    """Print the mean force and the free energy beside the known ones."""
    results = scan(*command_line_platform("Reference"))
    print("r (nm)   dF/dr found        known (kJ/mol/nm)   deviation / standard error")
    for each in results:
        known = known_mean_force(each.distance)
        sigmas = (each.value - known) / each.error
        print(f"{each.distance:.2f}   {each.value:8.2f} +- {each.error:4.2f}   {known:8.2f}   {sigmas:20.1f}")
    r = np.array(DISTANCES)
    found, known = (
        float(np.sum(np.diff(r) * (f[1:] + f[:-1]) / 2))
        for f in (np.array([each.value for each in results]), known_mean_force(r))
    )
    exact = WELL / 2 * ((r[-1] - REST) ** 2 - (r[0] - REST) ** 2) + (1.5 * POWER - 2) * KT * np.log(r[-1] / r[0])
    print(
        f"F({r[-1]}) - F({r[0]}): {found:.2f} kJ/mol by the trapezoidal rule; known forces so summed {known:.2f}, ",
        end="",
    )
    print(f"exact {exact:.2f}")


if __name__ == "__main__":
    main()
