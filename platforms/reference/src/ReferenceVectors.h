// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_REFERENCEVECTORS_H_
#define OPENMMVRATTLE_REFERENCEVECTORS_H_

#include "HostContext.h"
#include "openmm/reference/ReferencePlatform.h"

namespace OpenMMVRattle {

/** The state of a Context on the Reference platform and those derived from it, which have it as vectors. */
class ReferenceVectors : public HostContext {
public:
    ReferenceVectors(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator,
                     OpenMM::ReferencePlatform::PlatformData& data) : HostContext(context, integrator), data(data) {
    }
    const Vectors& getPositions() override {
        return *data.positions;
    }
    const Vectors& getVelocities() override {
        return *data.velocities;
    }
    Vectors& getForces() override {
        return *data.forces;
    }
    void writePositions(const Writer& write, bool) override {
        write(*data.positions);
    }
    void writeVelocities(const Writer& write, bool) override {
        write(*data.velocities);
    }
    const OpenMM::Vec3* getBoxVectors() override {
        return data.periodicBoxVectors;
    }
    double getTime() override {
        return data.time;
    }
    void setTime(double time) override {
        data.time = time;
    }
    long long getStepCount() override {
        return data.stepCount;
    }
    void setStepCount(long long count) override {
        data.stepCount = count;
    }

private:
    OpenMM::ReferencePlatform::PlatformData& data;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_REFERENCEVECTORS_H_
