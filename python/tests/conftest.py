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
from run_support import GPU, PRESENT  # noqa: E402

# GPUs are tested in double precision and with these files alone, for PoCL takes seconds to compile; the C++ tests tell
# most of it. (OpenMM's own constraint solver and its minimiser, which other files use, fail with PoCL.)
ON_GPU = ("test_step_to", "test_reversibility")
if GPU in PRESENT:
    openmm.Platform.getPlatform(GPU).setPropertyDefaultValue("Precision", "double")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that takes a platform on those that its file is meant for, unless it says itself on which."""
    says_itself = any("platform" in str(mark.args[0]) for mark in metafunc.definition.iter_markers("parametrize"))
    if "platform" in metafunc.fixturenames and not says_itself:
        names = ["Reference", "CPU"]
        if metafunc.module.__name__ in ON_GPU and GPU in PRESENT:
            names.append(GPU)
        metafunc.parametrize("platform", names, indirect=True)


@pytest.fixture
def platform(request: pytest.FixtureRequest) -> str:
    """The name of a platform on which the integrator runs."""
    if request.param not in PRESENT:
        pytest.skip(f"this OpenMM has no platform {request.param}")
    return request.param
