// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/VRattleDynamics.h"
#include <cmath>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// A step asked to end at a given time may be longer than the density says by this fraction, so that no sliver is left.
const double SLIVER = 1e-6;

} // namespace

VRattleDynamics::VRattleDynamics(const vector<double>& masses, const vector<DistanceConstraint>& distances,
                                 const vector<ExpressionConstraint>& expressions) :
        constraints(masses, distances, expressions), now(constraints.getSystem()), solver(constraints, now),
        monitors(constraints, solver, now), automatic(constraints, solver, now), control(&monitors), settings() {
    now.q.clear(); // there is no state yet
    constraints.moveTo(now.q, now.theta, now.force);
}

StepControl& VRattleDynamics::controlOf(const Settings& which) {
    if (which.isAutomatic)
        return automatic;
    return monitors;
}

void VRattleDynamics::setSettings(const Settings& newSettings, const vector<double>& references,
                                  StepControl::SettingsChange change) {
    settings = newSettings;
    solver.setSettings(settings.stepSize, settings.tolerance);
    control = &controlOf(settings);
    control->changeSettings(settings, references, change);
    if (change != StepControl::Nothing && control->hasStarted())
        formHalfStepVelocities();
}

void VRattleDynamics::begin(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                            double energy) {
    solver.motion.rest(now.theta);
    takeOver(positions, velocities, forces, energy);
    control->begin();
}

// An on-step state that no step has led to, from somebody else.
void VRattleDynamics::takeOver(const vector<Vec3>& positions, const vector<Vec3>& velocities,
                               const vector<Vec3>& forces, double energy) {
    now.q = positions;
    now.v = velocities;
    now.force = forces;
    now.groupEnergy = energy;
    // Particles without mass stay as they are, in whatever array is written.
    solver.next.q = positions;
    now.w = solver.next.w = solver.next.v = velocities;
    now.offset.found = now.offset.expected;
    constraints.finish(now.end(0.0));
}

// p[n-1/2] = p[n] + (h/(2 rho)) (grad V + G^T Lambda)   (docs/method.md, section 7)
void VRattleDynamics::formHalfStepVelocities() {
    const double kick = 0.5 * settings.stepSize / control->getDensity();
    const vector<double>& inverseMasses = constraints.getSystem().getInverseMasses();
    for (int i : constraints.getMovingParticles())
        now.w[i] = now.v[i] - now.force[i] * (kick * inverseMasses[i]);
    constraints.addTransposedOverMass(now.lambda, kick, now.w);
}

double VRattleDynamics::step(double maxStep) {
    constraints.beginStep();
    solver.prepare();
    if (control->hasStarted())
        solver.findJump(control->getDensity());
    else if (control->start())
        formHalfStepVelocities();
    control->solve(); // (3.9)-(3.11), (3.14)
    const double full = settings.stepSize / control->getNextDensity();
    if (!std::isfinite(full))
        throw StepFailure("the monitor is zero and there is no maximum step size; set one");
    const bool isShortened = full > maxStep || std::fabs(full - maxStep) <= SLIVER * full;
    const bool isDone = isShortened ? solver.solveFromOnStep(StepSolver::Shortened, maxStep)
                                    : control->hasStarted() || solver.solveFromOnStep(StepSolver::First, full);
    if (!isDone)
        control->throwNotConverged();
    solver.motion.setRates(solver.next.theta, solver.size);
    return solver.size;
}

bool VRattleDynamics::finish(vector<Vec3>& forces, double energy) {
    StepState& next = solver.next;
    next.force.swap(forces);
    next.groupEnergy = energy;
    if (!control->finish()) // (3.12)-(3.13)
        return false;
    // From here on nothing fails.
    constraints.endStep();
    solver.accept(now);
    constraints.moveToEnd();
    control->accept();
    if (control->hasStarted() && solver.kind == StepSolver::Shortened)
        formHalfStepVelocities();
    return true;
}

// The step that would have come leads from where it leads to back to here.
void VRattleDynamics::reverse() {
    if (control->hasStarted()) {
        solver.prepare();
        control->solve();
        now.offset.found.swap(solver.next.offset.found);
        now.offset.expected = now.lambda;
        for (int i : constraints.getMovingParticles())
            now.w[i] = -solver.next.w[i];
        control->reverse();
    }
    for (int i : constraints.getMovingParticles())
        now.v[i] = -now.v[i];
    for (double& each : now.theta.rates)
        each = -each;
}
