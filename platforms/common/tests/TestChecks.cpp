// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "GpuTests.h"

#include "TestChecks.h"

int main(int argc, char** argv) {
    return OpenMMVRattle::runOnPlatform(OpenMMVRattle::getCheckTests(), argc, argv);
}
