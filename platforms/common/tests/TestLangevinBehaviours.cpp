// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "GpuTests.h"

#include "TestLangevinBehaviours.h"

int main(int argc, char** argv) {
    return OpenMMVRattle::runOnPlatform(OpenMMVRattle::getLangevinTests(), argc, argv);
}
