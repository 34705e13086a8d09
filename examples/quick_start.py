# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""A double pendulum: the steps shrink by orders of magnitude in each whip, and the energy stays.

python examples/quick_start.py [--platform NAME] [--precision NAME]
"""

import openmm
from openmmvrattle import VariableStepRattleIntegrator
from openmmvrattle.platforms import command_line_platform
from openmmvrattle.testsystems import double_pendulum

pendulum = double_pendulum()
# was: integrator = openmm.VerletIntegrator(0.0005)
integrator = VariableStepRattleIntegrator(0.0005, automatic=True)  # the step in ps, while nothing unusual happens
context = openmm.Context(pendulum.system, integrator, *command_line_platform("Reference"))
context.setPositions(pendulum.positions)
context.setVelocities(pendulum.velocities)
for _ in range(20):
    steps = []
    for _ in range(1000):
        integrator.step(1)
        steps.append(integrator.getStepSize()._value)
    state = context.getState(energy=True)
    time, step = state.getTime()._value, min(steps)
    energy = (state.getKineticEnergy() + state.getPotentialEnergy())._value
    print(f"time {time:.4f} ps   smallest step {step:.1e} ps   energy {energy:.4f} kJ/mol")
