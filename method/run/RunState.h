// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_RUNSTATE_H_
#define OPENMMVRATTLE_RUNSTATE_H_

#include "openmm/Vec3.h"
#include "openmm/serialization/SerializationNode.h"
#include <iosfwd>
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** What a method finds in the course of a run, and a new start does not take from it. */
struct Findings {
    std::vector<double> references;  // U_k,ref in force of each value of getMonitorValues(), 0 if not known
    double referenceTemperature = 0; // 2K/f (kJ/mol) where automatic step control found its own; 0 if it did not
    std::vector<double> random;      // the seed in force, and how many steps have drawn numbers with it; or empty
};

/** What has been counted of the steps of a method since it exists; each counts what it knows of. */
struct StepCounts {
    long long rescues = 0;    // steps that took the density of another update
    long long shortSteps = 0; // the most in a row that were shorter than a tenth of the nominal one
    long long substepped = 0; // steps that were made of substeps
    int largestSubsteps = 1;  // and of how many at most
};

/**
 * What a run needs to go on as if nothing had happened, beside the settings of the integrator and the positions,
 * velocities and parameters of the Context. Checkpoints and States hold it.
 *
 * The forces are in it to be compared with those at the restored positions: a State may be given to a Context whose
 * forces are others, and then the run must start afresh.
 */
struct RunState {
    /** Write or read everything, in binary form with a stream and as text with a SerializationNode. */
    void write(std::ostream& stream) const;
    void read(std::istream& stream);
    void write(OpenMM::SerializationNode& node) const;
    void read(const OpenMM::SerializationNode& node);
    /** Throw an OpenMMException unless every list has the length that fits. */
    void requireSizes(int numParticles, int numMonitors) const;
    /** The method's numbers of a name; throws an OpenMMException if they are not there or not as many as wanted. */
    const std::vector<double>& getMethodValues(const std::string& name, size_t count) const;
    /** Writes the method's numbers into a saved run or reads them from it, so that what they are is listed once. */
    class Archive {
    public:
        explicit Archive(RunState& to) : to(&to), from(to) {
        }
        explicit Archive(const RunState& from) : to(nullptr), from(from) {
        }
        void add(const std::string& name, std::vector<double>& values, size_t count);
        /** Numbers that stand apart, as one list. */
        void add(const std::string& name, const std::vector<double*>& numbers);
        void add(const std::string& name, double& value) {
            add(name, {&value});
        }
        void add(const std::string& name, bool& value) {
            double number = value;
            add(name, number);
            value = number != 0;
        }

    private:
        RunState* to; // or null
        const RunState& from;
    };

    unsigned long long system = 0;     // fingerprint of the System
    unsigned long long context = 0;    // fingerprint of the Context: RunDevice::getFingerprint()
    unsigned long long parameters = 0; // and of its parameters
    bool areForcesOutdated = false;    // the forces are those before the parameters of a Force were changed
    double lastStepSize = 0;           // ps; 0 before the first step
    double lastDensity = 1;            // rho of the last step
    Findings findings;
    bool startsAfresh = true;          // no step since the user changed the state: nothing of what follows is there

    // The numbers that the method goes on with, by names that the device gives them.
    std::map<std::string, std::vector<double>> methodValues;
    std::vector<OpenMM::Vec3> halfStepVelocities; // M^-1 p[n-1/2], of methods that have it
    std::vector<OpenMM::Vec3> forces;  // F(q[n])
    double groupEnergy = 0;            // of the monitor's force group at q[n], kJ/mol
    OpenMM::Vec3 boxVectors[3];        // those of the forces
    // q[n] and M^-1 p[n], where they are not those in the Context; empty if they are.
    std::vector<OpenMM::Vec3> positions, velocities;
    // Where the Context's state is not the method's: what the method knows of the former, if it has changed since.
    bool isContextAhead = false;
    std::vector<OpenMM::Vec3> contextPositions, contextVelocities;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_RUNSTATE_H_
