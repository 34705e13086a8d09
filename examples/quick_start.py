# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""A double pendulum: the steps shrink by orders of magnitude in each whip, and the energy stays."""

import openmm
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.testsystems import double_pendulum

pendulum = double_pendulum()
integrator = VariableStepRattleIntegrator(0.01)  # ps, the size of the first step
integrator.setMinimumStepSize(1e-6)
integrator.setMaximumStepSize(0.02)
context = openmm.Context(pendulum.system, integrator, openmm.Platform.getPlatformByName("Reference"))
context.setPositions(pendulum.positions)
context.setVelocities(pendulum.velocities)
for _ in range(20):
    integrator.step(1000)
    state = context.getState(energy=True)
    time, step = state.getTime()._value, integrator.getStepSize()._value
    energy = (state.getKineticEnergy() + state.getPotentialEnergy())._value
    print(f"time {time:.4f} ps   step {step:.1e} ps   energy {energy:.4f} kJ/mol")
