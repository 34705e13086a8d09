# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""OpenMM's XmlSerializer, returning our own classes for our own integrators."""

from __future__ import annotations

import sys

import openmm

from .custom import CustomVariableStepRattleIntegrator


class XmlSerializer(openmm.XmlSerializer):
    """OpenMM's XmlSerializer in all respects but one: what it returns for one of our integrators is of our own class.

    openmm.XmlSerializer writes the same XML and reads it as well, but as it knows OpenMM's own classes only, it
    returns a VariableStepRattleIntegrator as a bare openmm.Integrator, and a CustomVariableStepRattleIntegrator as an
    openmm.CustomIntegrator, for the method cast() of either class.
    """

    @staticmethod
    def deserialize(inputString: str) -> object:
        """Reconstruct an object that has been serialized as XML."""
        return with_class(openmm.XmlSerializer.deserialize(inputString))

    @staticmethod
    def clone(object: object) -> object:
        """Clone an object by serializing and deserializing it, without the detour of an XML text."""
        return with_class(openmm.XmlSerializer.clone(object))


def with_class(result: object) -> object:
    """What OpenMM has returned, of our own class if it is one of our integrators."""
    # The compiled class exists only where it could be loaded.
    compiled = sys.modules.get(f"{__package__}.integrators")
    classes = [CustomVariableStepRattleIntegrator]
    if compiled:
        classes += [compiled.VariableStepRattleIntegrator, compiled.VariableStepRattleLangevinIntegrator]
    for each in classes:
        if isinstance(result, openmm.Integrator) and each.isinstance(result):
            return each.cast(result)
    return result
