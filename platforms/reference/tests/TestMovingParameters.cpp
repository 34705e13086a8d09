// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "TestMovingParameters.h"
#include "ReferenceTests.h"

using namespace OpenMMVRattle;

int main(int argc, char** argv) {
    return runOnPlatform({{"cost and energy balance", testCostAndBalance},
                          {"the monitor of half steps after a jump of the force", testMonitorAfterJumpOfForce},
                          {"a force that is updated", testUpdatedForce},
                          {"runs saved in the middle", testSavedInTheMiddle},
                          {"a trial run in between", testTrialRunInBetween},
                          {"a jump that is too large", testTooLargeJump},
                          {"stepTo()", testStepToWhileMoving}},
                         argc, argv);
}
