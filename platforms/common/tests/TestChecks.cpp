// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "TestChecks.h"
#include "GpuTests.h"

using namespace OpenMMVRattle;

int main(int argc, char** argv) {
    return runOnPlatform({{"masses", testMasses},
                          {"lengths", testLengths},
                          {"constraints on virtual sites", testConstrainedSites},
                          {"thermostats and expressions", testThermostats},
                          {"barostats and expressions", testBarostats},
                          {"wrapped positions", testWrappedPositions},
                          {"a long bond in a skewed box", testLongBondInSkewedBox},
                          {"wrapped positions with few digits", testPositionsFromFiles},
                          {"starts far off", testStartsFarOff},
                          {"a ring through the box", testRingThroughTheBox},
                          {"a wrapped particle on a sphere", testWrappedParticleOnSphere},
                          {"positions", testPositions},
                          {"positions far out", testPositionsFarOut},
                          {"the smallest step", testSmallestStep},
                          {"constraints that contradict each other", testConstraintsThatContradictEachOther},
                          {"velocities that are too fast", testFastVelocities},
                          {"velocities of coupled constraints", testVelocitiesOfCoupledConstraints},
                          {"the distribution of velocities", testMaxwellVelocities},
                          {"seeds and errors of velocities", testSeedsAndErrorsOfVelocities},
                          {"velocities off the constraints", testVelocitiesOffTheConstraints}},
                         argc, argv);
}
