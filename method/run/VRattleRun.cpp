// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/VRattleRun.h"
#include <algorithm>
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// Keeps what is at rest from being divided by zero.
const double TINY = 1e-100;

} // namespace

void VRattleRun::putBack(const Kept& kept) {
    settings = kept.settings;
    now = kept.state;
    solver.motion.target = kept.target;
    solver.setSettings(settings.stepSize, settings.tolerance);
    constraints.moveTo(now.q, now.theta, now.force);
    control = &controlOf(settings);
    control->applySettings(settings);
    setMemory(kept.memory);
}

void VRattleRun::setMemory(const Memory& memory) {
    control->setMemory(memory);
    control->setReferences(memory.references);
    automatic.getControl().setMemory(memory.automatic);
}

template <class Change> void VRattleRun::attempt(const Change& change) {
    const Kept before = keep();
    try {
        change();
    }
    catch (...) {
        putBack(before);
        throw;
    }
}

void VRattleRun::begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                       double energy) {
    attempt([&] { VRattleDynamics::begin(positions, velocities, forces, energy); });
}

void VRattleRun::adoptParameters() {
    now.theta.values = solver.motion.target;
    constraints.moveTo(now.q, now.theta, now.force);
}

void VRattleRun::adopt(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                       double energy, const ExpressionParameters& theta, const Memory& memory) {
    attempt([&] {
        now.theta = theta;
        takeOver(positions, velocities, forces, energy);
        control->begin();
    });
    now.v = velocities; // which have been projected, and so changed in the last bits
    adopt(memory);
    formHalfStepVelocities();
}

// With S_c of begin().
void VRattleRun::adopt(const Memory& memory) {
    control->setMemory(memory);
    if (!settings.isAutomatic)
        return;
    setReferences(memory.references);
    AutomaticControl::Memory own = automatic.getControl().getMemory();
    static_cast<AutomaticRecursions::AutomaticNumbers&>(own) = memory.automatic;
    automatic.getControl().setMemory(own);
}

void VRattleRun::resume(const StepState& state, const Memory& memory) {
    attempt([&] {
        now.theta = state.theta;
        takeOver(state.q, state.v, state.force, state.groupEnergy);
        control->begin();
    });
    StepState exact = state; // this has projected the velocities, which changes the last bits
    exact.rightSide = now.rightSide;
    exact.forceParts = now.forceParts;
    putBack({settings, exact, solver.motion.target, memory});
}

void VRattleRun::changeState(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                             double energy) {
    attempt([&] {
        takeOver(positions, velocities, forces, energy);
        control->change(StepControl::Everything, 1.0);
    });
    if (control->hasStarted())
        formHalfStepVelocities();
}

bool VRattleRun::changeFrame(const vector<Vec3>& before, const vector<Vec3>& velocities) {
    const vector<int>& movingParticles = constraints.getMovingParticles();
    const bool areOwn = &before == &now.v;
    Vec3 shift;
    if (!constraints.findFrameShift(before, velocities, shift))
        return false;
    constraints.share((int) movingParticles.size(), [&](int first, int end) {
        for (int p = first; p < end; p++) {
            const int i = movingParticles[p];
            now.v[i] = areOwn ? velocities[i] : now.v[i] + shift;
            now.w[i] += shift;
        }
    });
    control->change(StepControl::Frame, 0.0);
    return true;
}

void VRattleRun::changeVelocities(const vector<Vec3>& velocities) {
    const vector<double>& masses = getConstraintSystem().getMasses();
    vector<Vec3>& change = solver.next.v;
    for (int i : constraints.getMovingParticles())
        change[i] = velocities[i] - now.v[i];
    constraints.projectVelocities(change);
    for (int i : constraints.getMovingParticles()) {
        now.v[i] += change[i];
        now.w[i] += change[i];
    }
    constraints.findMultipliers(now.v, now.theta, now.lambda, now.rightSide);
    const double part = constraints.sumOfSquares(change, masses) / (constraints.sumOfSquares(now.v, masses) + TINY);
    control->change(StepControl::Velocities, std::min(1.0, std::sqrt(part)));
}

void VRattleRun::changeForces(vector<Vec3>& forces, double energy) {
    const vector<double>& inverseMasses = getConstraintSystem().getInverseMasses();
    vector<Vec3>& change = solver.next.v;
    for (int i : constraints.getMovingParticles())
        change[i] = forces[i] - now.force[i];
    const double changeSquared = constraints.sumOfSquares(change, inverseMasses);
    const double forceSquared =
        std::max(constraints.sumOfSquares(forces, inverseMasses), constraints.sumOfSquares(now.force, inverseMasses));
    const Memory memory = getMemory();
    const vector<double> values = now.values, forceParts = now.forceParts;
    auto exchange = [&] {
        now.force.swap(forces);
        std::swap(now.groupEnergy, energy);
        now.lambda.swap(solver.next.lambda);
        now.rightSide.swap(solver.next.rightSide);
        constraints.moveTo(now.q, now.theta, now.force);
    };
    exchange();
    try {
        constraints.findMultipliers(now.v, now.theta, now.lambda, now.rightSide);
        control->change(StepControl::Forces, std::min(1.0, std::sqrt(changeSquared / (forceSquared + TINY))));
    }
    catch (...) {
        exchange();
        now.values = values;
        now.forceParts = forceParts;
        setMemory(memory);
        throw;
    }
    if (control->hasStarted())
        formHalfStepVelocities();
}
