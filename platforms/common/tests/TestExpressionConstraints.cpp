// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "GpuTests.h"

#include "TestExpressionConstraints.h"

int main(int argc, char** argv) {
    return OpenMMVRattle::runOnPlatform(OpenMMVRattle::getExpressionTests(), argc, argv);
}
