# OpenMM-VRATTLE: fixtures of the Python tests.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import openmm
import pytest


@pytest.fixture(params=["Reference", "CPU"])
def platform(request: pytest.FixtureRequest) -> str:
    """The name of a platform on which the integrator runs."""
    names = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
    if request.param not in names:
        pytest.skip(f"this OpenMM has no platform {request.param}")
    return request.param
