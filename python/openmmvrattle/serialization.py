# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""OpenMM's XmlSerializer, returning our own class for our own integrators."""

from __future__ import annotations

import openmm

from .vrattle import VariableStepRattleIntegrator


class XmlSerializer(openmm.XmlSerializer):
    """OpenMM's XmlSerializer in all respects but one: what it returns for a VariableStepRattleIntegrator is one.

    openmm.XmlSerializer writes the same XML and reads it as well, but as it knows OpenMM's own classes only, it returns
    the integrator as a bare openmm.Integrator, for VariableStepRattleIntegrator.cast().
    """

    @staticmethod
    def deserialize(inputString: str) -> object:
        """Reconstruct an object that has been serialized as XML."""
        return _with_class(openmm.XmlSerializer.deserialize(inputString))

    @staticmethod
    def clone(object: object) -> object:
        """Clone an object by serializing and deserializing it, without the detour of an XML text."""
        return _with_class(openmm.XmlSerializer.clone(object))


def _with_class(result: object) -> object:
    if isinstance(result, openmm.Integrator) and VariableStepRattleIntegrator.isinstance(result):
        return VariableStepRattleIntegrator.cast(result)
    return result
