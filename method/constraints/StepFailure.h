// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPFAILURE_H_
#define OPENMMVRATTLE_STEPFAILURE_H_

#include <stdexcept>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** Particles for a message, the first of them where they are many. */
inline std::string listParticles(const std::vector<int>& particles, size_t maxListed = 12) {
    std::string text = particles.size() == 1 ? "particle " : "the particles ";
    for (size_t i = 0; i < particles.size() && i < maxListed; i++)
        text += (i == 0 ? "" : i + 1 == particles.size() ? " and " : ", ") + std::to_string(particles[i]);
    return particles.size() > maxListed ? text + ", ... (" + std::to_string(particles.size()) + " in all)" : text;
}

/** Do something, and undo it where it fails, whatever it throws. */
template <class Action, class Undo> void attempt(const Action& action, const Undo& undo) {
    try {
        action();
    }
    catch (...) {
        undo();
        throw;
    }
}

/** A step, or the start of a run, could not be completed. The state before it is untouched. */
class StepFailure : public std::runtime_error {
public:
    /** @param reason    what happened, as the end of the sentence "the step failed because ..." */
    explicit StepFailure(const std::string& reason) : std::runtime_error(reason) {
    }
};

/** The forces are none that anything can be computed with. */
class UselessForces : public StepFailure {
public:
    using StepFailure::StepFailure;
};

/** The constraints among some particles depend on each other, so that their multipliers are not defined. */
class DependentConstraints : public StepFailure {
public:
    /**
     * @param particles      those of the cluster
     * @param explanation    what more is known, with the way out; may be empty
     */
    DependentConstraints(const std::vector<int>& particles, const std::string& explanation) :
            StepFailure(describe(particles) + (explanation.empty() ? "" : "; " + explanation)) {
    }

private:
    static std::string describe(const std::vector<int>& particles) {
        return "the constraints " + std::string(particles.size() == 1 ? "of " : "among ") + listParticles(particles) +
               " are redundant or nearly so in the current configuration; remove one of them if they are so in every "
               "configuration";
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPFAILURE_H_
