// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_COMPUTEVECTORS_H_
#define OPENMMVRATTLE_COMPUTEVECTORS_H_

#include "HostContext.h"
#include "openmm/Kernel.h"
#include "openmm/internal/ContextImpl.h"

namespace OpenMMVRattle {

/**
 * The state of a Context whose platform has it on a device. Each reading waits for the device and copies. A kernel of our own moves
 * it, for ContextImpl would announce what it writes as a change by the user.
 */
class ComputeVectors : public HostContext {
public:
    ComputeVectors(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator);
    const Vectors& getPositions() override;
    const Vectors& getVelocities() override;
    Vectors& getForces() override;
    void writePositions(const Writer& write, bool areAll) override;
    void writeVelocities(const Writer& write, bool areAll) override;
    const OpenMM::Vec3* getBoxVectors() override;
    double getTime() override;
    void setTime(double time) override;
    long long getStepCount() override;
    void setStepCount(long long count) override;

    /** How often positions have been written, after which forces are others. */
    int getNumWrites() const {
        return numWrites;
    }

private:
    OpenMM::Kernel kernel;
    Vectors positions, velocities, forces;
    OpenMM::Vec3 box[3];
    int numWrites;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_COMPUTEVECTORS_H_
