// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_WATCHEDFORCE_H_
#define OPENMMVRATTLE_WATCHEDFORCE_H_

#include "openmm/Force.h"
#include "openmm/OpenMMException.h"
#include "openmm/Vec3.h"
#include "openmm/internal/ContextImpl.h"
#include "openmm/internal/CustomCPPForceImpl.h"
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** What a WatchedForce does and has seen. */
struct Watch {
    typedef std::vector<OpenMM::Vec3> Vectors;
    /** Computes the forces at positions, a time and a value of the Context's parameter "strength", and returns the energy. */
    std::function<double(const Vectors&, double, double, Vectors&)> compute;
    enum Failure { None, Raises, NotANumber };
    Failure failure = None;
    int evaluationsToFailure = 0; // the next one is 1
    struct Seen {
        double time;
        long long stepCount;
    };
    std::vector<Seen> seen; // at each evaluation

    /** Make an evaluation from now on fail, once. */
    void failAt(int evaluation, Failure how) {
        evaluationsToFailure = evaluation;
        failure = how;
    }
    void recover() {
        failure = None;
    }
    bool hasFailed() const {
        return failure != None && evaluationsToFailure <= 0;
    }
};

/** A Force given as a function, that can be told to fail, and keeps a record of the time at which it is computed. */
class WatchedForce : public OpenMM::Force {
public:
    explicit WatchedForce(const std::shared_ptr<Watch>& watch) : watch(watch) {
    }
    bool usesPeriodicBoundaryConditions() const override {
        return false;
    }

protected:
    class Impl : public OpenMM::CustomCPPForceImpl {
    public:
        explicit Impl(const WatchedForce& owner) : OpenMM::CustomCPPForceImpl(owner), owner(owner), watch(owner.watch) {
        }
        const OpenMM::Force& getOwner() const override {
            return owner;
        }
        std::map<std::string, double> getDefaultParameters() override {
            return {{"strength", 1.0}};
        }
        double computeForce(OpenMM::ContextImpl& context, const std::vector<OpenMM::Vec3>& positions,
                            std::vector<OpenMM::Vec3>& forces) override {
            watch->seen.push_back({context.getTime(), context.getStepCount()});
            const double energy =
                watch->compute(positions, context.getTime(), context.getParameter("strength"), forces);
            if (watch->failure != Watch::None && --watch->evaluationsToFailure == 0) {
                if (watch->failure == Watch::Raises)
                    throw OpenMM::OpenMMException("the force is out of order");
                forces[0][0] = std::numeric_limits<double>::quiet_NaN();
            }
            return energy;
        }

    private:
        const WatchedForce& owner;
        std::shared_ptr<Watch> watch;
    };
    OpenMM::ForceImpl* createImpl() const override {
        return new Impl(*this);
    }

private:
    std::shared_ptr<Watch> watch;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_WATCHEDFORCE_H_
