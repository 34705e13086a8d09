# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Variable steps on a platform for which this package has no kernels, such as a GPU with OpenCL, CUDA or HIP.

Eight rigid waters on the fastest platform of this machine, there and back: the integrator is turned round after some
steps, retraces its way, and the distance from the start is printed. Beside it stands the largest energy error.

    python examples/any_platform.py [--platform OpenCL] [--precision mixed] [--steps 200]
"""

from __future__ import annotations

import argparse

import numpy as np
import openmm
from openmm import unit
from openmmvrattle import CustomVariableStepRattleIntegrator
from openmmvrattle.testsystems import rigid_waters


def fastest_platform() -> openmm.Platform:
    """The platform that OpenMM would choose by itself."""
    platforms = [openmm.Platform.getPlatform(i) for i in range(openmm.Platform.getNumPlatforms())]
    return max(platforms, key=lambda platform: platform.getSpeed())


def there_and_back(platform: openmm.Platform, precision: str, steps: int) -> tuple[float, float, np.ndarray]:
    """The distance from the start (nm), the largest energy error (kJ/mol), and the sizes of the steps (ps)."""
    water = rigid_waters()
    integrator = CustomVariableStepRattleIntegrator(
        1 * unit.femtosecond, monitors=[CustomVariableStepRattleIntegrator.ConstraintAndAppliedForce]
    )
    properties = {"Precision": precision} if "Precision" in platform.getPropertyNames() else {}
    context = openmm.Context(water.system, integrator, platform, properties)
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
    parser.add_argument("--platform", help="name of a platform of OpenMM (default: the fastest)")
    parser.add_argument("--precision", choices=["single", "mixed", "double"], default="mixed")
    parser.add_argument("--steps", type=int, default=200)
    arguments = parser.parse_args()
    platform = openmm.Platform.getPlatform(arguments.platform) if arguments.platform else fastest_platform()
    distance, energy_error, sizes = there_and_back(platform, arguments.precision, arguments.steps)
    print(f"{arguments.steps} steps of {1e3 * sizes.min():.2f} to {1e3 * sizes.max():.2f} fs on {platform.getName()}")
    print(f"energy within {energy_error:.3f} kJ/mol")
    print(f"there and back: {distance:.1e} nm from the start")


if __name__ == "__main__":
    main()
