// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONTEXTVECTORS_H_
#define OPENMMVRATTLE_CONTEXTVECTORS_H_

#include "openmm/Vec3.h"
#include <functional>
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * All that a device on the host needs of a Context: its state, wherever the platform has it, read and written as vectors of the host
 * without announcing a change, and what can be computed there.
 */
class ContextVectors {
public:
    typedef std::vector<OpenMM::Vec3> Vectors;
    virtual ~ContextVectors() = default;
    /** Valid until the state changes. */
    virtual const Vectors& getPositions() = 0;
    virtual const Vectors& getVelocities() = 0;
    /** Of the last evaluation, to be read once: whoever does may take the storage and leave other in its place. */
    virtual Vectors& getForces() = 0;
    /** Writes some of the vectors that it is given, and leaves the others as they are. */
    typedef std::function<void(Vectors&)> Writer;
    /**
     * Have positions or velocities written, in place if they are vectors of the host and else in a copy that takes their place.
     *
     * @param areAll    each of them is written, so that it is of no interest what they were
     */
    virtual void writePositions(const Writer& write, bool areAll) = 0;
    virtual void writeVelocities(const Writer& write, bool areAll) = 0;
    void setPositions(const Vectors& positions) {
        writePositions([&](Vectors& to) { to = positions; }, true);
    }
    /** The three periodic box vectors. */
    virtual const OpenMM::Vec3* getBoxVectors() = 0;
    virtual double getTime() = 0;
    virtual void setTime(double time) = 0;
    virtual long long getStepCount() = 0;
    virtual void setStepCount(long long count) = 0;

    /** The parameters of Forces. */
    virtual const std::map<std::string, double>& getParameters() = 0;
    /** Whether the integrator is one of several that take steps in the Context. */
    virtual bool isSharedByIntegrators() = 0;
    /** Let the Forces that act between steps do so; returns whether one of them says that the forces are no longer valid. */
    virtual bool updateState() = 0;
    /** Throw an OpenMMException if nobody has set positions. */
    virtual void requirePositions() = 0;
    virtual void computeVirtualSites() = 0;
    /** Let nobody take the forces there are for those of the positions there are. */
    virtual void invalidateForces() = 0;
    /**
     * Compute the forces of some groups, a bit for each.
     *
     * @param energyGroup    a group whose energy is wanted; negative for none
     * @return that energy
     */
    virtual double computeForces(int groups, int energyGroup) = 0;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONTEXTVECTORS_H_
