# OpenMM-VRATTLE: fixtures of the Python tests.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import os

# A Context for which no platform is named is one on CPU, also where there is a faster platform. This must be set before
# OpenMM is imported, and holds for the scripts that tests run too. (OpenCL on a processor, PoCL, is there for the tests
# that name it; with PoCL 3.1 OpenMM's minimiser crashes.)
os.environ.setdefault("OPENMM_DEFAULT_PLATFORM", "CPU")

import openmm  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture(params=["Reference", "CPU"])
def platform(request: pytest.FixtureRequest) -> str:
    """The name of a platform on which the integrator runs."""
    names = {openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())}
    if request.param not in names:
        pytest.skip(f"this OpenMM has no platform {request.param}")
    return request.param
