# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""VRATTLE as an openmm.CustomIntegrator: in Python alone, for every platform; docs/custom.md explains how it works."""

from .integrator import ConstraintWarning, CustomVariableStepRattleIntegrator

__all__ = ["ConstraintWarning", "CustomVariableStepRattleIntegrator"]
