# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Variable steps on any platform, there and back: how exactly does a run retrace its way?

Eight rigid waters on the fastest platform of this machine: the integrator is turned round after some steps, retraces
its way, and the distance from the start is printed: less than 1e-10 nm on Reference, and some 1e-8 in mixed precision.
Beside it stands the largest energy error. With --custom it is the integrator that is written in Python alone.

    python examples/any_platform.py [--platform OpenCL] [--precision mixed] [--steps 200] [--custom]
"""

from __future__ import annotations

import argparse

import numpy as np
import openmm
from openmm import unit
from openmmvrattle import CustomVariableStepRattleIntegrator, VariableStepRattleIntegrator
from openmmvrattle.platforms import add_platform_arguments, platform_and_properties, platform_from
from openmmvrattle.testsystems import rigid_waters


def fastest_platform() -> str:
    """The platform that OpenMM would choose by itself."""
    platforms = [openmm.Platform.getPlatform(i) for i in range(openmm.Platform.getNumPlatforms())]
    return max(platforms, key=lambda platform: platform.getSpeed()).getName()


def there_and_back(platform: str, steps: int, custom: bool = False) -> tuple[float, float, np.ndarray]:
    """The distance from the start (nm), the largest energy error (kJ/mol), and the sizes of the steps (ps)."""
    water = rigid_waters()
    kind = CustomVariableStepRattleIntegrator if custom else VariableStepRattleIntegrator
    integrator = kind(1 * unit.femtosecond, monitors=[kind.ConstraintAndAppliedForce])
    context = openmm.Context(water.system, integrator, *platform_and_properties(platform))
    context.setPositions(water.positions)
    context.setVelocities(water.velocities)
    energies, sizes = [], []
    for half in range(2):
        if half == 1:
            integrator.reverse()
        for _ in range(steps):
            integrator.step(1)
            state = context.getState(energy=True)
            energy = state.getKineticEnergy() + state.getPotentialEnergy()
            energies.append(energy.value_in_unit(unit.kilojoule_per_mole))
            sizes.append(integrator.getStepSize().value_in_unit(unit.picosecond))
    end = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    return float(np.max(np.abs(end - water.positions))), float(np.ptp(energies)), np.array(sizes)


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_platform_arguments(parser, "the fastest")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--custom", action="store_true", help="the integrator that is written in Python alone")
    options = parser.parse_args()
    try:
        platform = platform_from(options, fastest_platform())
    except ValueError as error:
        parser.error(f"{error}.")
    distance, energy_error, sizes = there_and_back(platform, options.steps, options.custom)
    print(f"{options.steps} steps of {1e3 * sizes.min():.2f} to {1e3 * sizes.max():.2f} fs on {platform}")
    print(f"energy within {energy_error:.3f} kJ/mol")
    print(f"there and back: {distance:.1e} nm from the start")


if __name__ == "__main__":
    main()
