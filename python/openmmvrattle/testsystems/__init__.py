# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Systems with constraints on which integrators can be compared.

Each function builds one system in code, with a start that meets all constraints, and the settings with which
``python -m openmmvrattle compare`` runs it. Some show where variable steps pay, others where they do not.

>>> from openmmvrattle.testsystems import SYSTEMS
>>> pendulum = SYSTEMS["double-pendulum"]()

Units are OpenMM's: nm, ps, amu, kJ/mol. Positions and velocities are plain NumPy arrays in nm and nm/ps.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

from openmm import app

from .base import (
    ComparisonSettings,
    ExpressionConstraint,
    MonitorSettings,
    StepControl,
    TestSystem,
    constraint_error,
    project_onto_constraints,
)
from .mechanical import double_pendulum, independent_whips, light_heavy_chain, long_light_heavy_chain
from .molecular import (
    alanine_dipeptide,
    argon_cluster,
    colliding_water_clusters,
    diatomic_on_wall,
    flexible_waters,
    ion_pair,
    nitrogen_collision,
    peptide_in_water,
    polymer,
    rigid_waters,
    water_clash,
)
from .rod import elastic_rod

__all__ = [
    "SYSTEMS",
    "ComparisonSettings",
    "ExpressionConstraint",
    "MonitorSettings",
    "StepControl",
    "TestSystem",
    "alanine_dipeptide",
    "argon_cluster",
    "colliding_water_clusters",
    "constraint_error",
    "diatomic_on_wall",
    "double_pendulum",
    "elastic_rod",
    "flexible_waters",
    "independent_whips",
    "ion_pair",
    "light_heavy_chain",
    "long_light_heavy_chain",
    "nitrogen_collision",
    "peptide_in_water",
    "polymer",
    "project_onto_constraints",
    "rigid_waters",
    "water_clash",
]

SYSTEMS: dict[str, Callable[[], TestSystem]] = {
    "double-pendulum": double_pendulum,
    "double-pendulum-heavy-inside": functools.partial(double_pendulum, inner_mass=1000.0, outer_mass=1.0),
    "light-heavy-chain": light_heavy_chain,
    "light-heavy-chain-repulsion": functools.partial(light_heavy_chain, repulsion=True),
    "water-clash": water_clash,
    "nitrogen-collision-5": nitrogen_collision,
    "nitrogen-collision-20": functools.partial(nitrogen_collision, 20.0),
    "diatomic-on-wall": diatomic_on_wall,
    "elastic-rod": elastic_rod,
    "alanine-dipeptide-hbonds": functools.partial(alanine_dipeptide, app.HBonds),
    "alanine-dipeptide-hbonds-1000-kelvin": functools.partial(alanine_dipeptide, app.HBonds, temperature=1000.0),
    "alanine-dipeptide-allbonds": functools.partial(alanine_dipeptide, app.AllBonds),
    "rigid-waters": rigid_waters,
    "rigid-waters-32": functools.partial(rigid_waters, 32),
    "long-light-heavy-chain": long_light_heavy_chain,
    "independent-whips": independent_whips,
    "diatomic-on-wall-5": functools.partial(diatomic_on_wall, 5.0),
    "diatomic-on-wall-10": functools.partial(diatomic_on_wall, 10.0),
    "ion-pair": ion_pair,
    "colliding-water-clusters": colliding_water_clusters,
    "peptide-in-water": peptide_in_water,
    "polymer": polymer,
    "argon-cluster": argon_cluster,
    "flexible-waters": flexible_waters,
}
"""The systems by the names under which the command line knows them; each value is called without arguments."""
