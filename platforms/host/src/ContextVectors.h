// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONTEXTVECTORS_H_
#define OPENMMVRATTLE_CONTEXTVECTORS_H_

#include "openmm/Vec3.h"
#include <vector>

namespace OpenMMVRattle {

/** The state of a Context, wherever the platform has it, read and written as vectors of the host, without announcing a change. */
class ContextVectors {
public:
    typedef std::vector<OpenMM::Vec3> Vectors;
    virtual ~ContextVectors() = default;
    /** Valid until the state changes. */
    virtual const Vectors& getPositions() = 0;
    virtual const Vectors& getVelocities() = 0;
    /** Of the last evaluation, to be read once: whoever does may take the storage and leave other in its place. */
    virtual Vectors& getForces() = 0;
    virtual void setPositions(const Vectors& positions) = 0;
    virtual void setVelocities(const Vectors& velocities) = 0;
    /** Where positions and velocities may be written in place, or null if they are elsewhere. */
    virtual Vectors* accessPositions() {
        return nullptr;
    }
    virtual Vectors* accessVelocities() {
        return nullptr;
    }
    /** The three periodic box vectors. */
    virtual const OpenMM::Vec3* getBoxVectors() = 0;
    virtual double getTime() = 0;
    virtual void setTime(double time) = 0;
    virtual long long getStepCount() = 0;
    virtual void setStepCount(long long count) = 0;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONTEXTVECTORS_H_
