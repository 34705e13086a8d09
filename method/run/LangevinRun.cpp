// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/LangevinRun.h"
#include "run/IntegratorSettings.h"
#include <stdexcept>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

void LangevinRun::beginFixedSteps(double) {
    throw std::logic_error("this method has no trial runs");
}

Findings LangevinRun::getFindings() const {
    return {getReferences(), 0.0, getRandomState()};
}

void LangevinRun::setFindings(const Findings& findings) {
    setReferences(findings.references);
    setRandomState(findings.random);
}

StepCounts LangevinRun::getCounts() const {
    StepCounts counts;
    counts.substepped = getNumSubstepped();
    counts.largestSubsteps = getLargestSubsteps();
    return counts;
}

// ------------------------------------------------------------------------------------------------- saving and resuming

void LangevinRun::exchange(Memory& memory, RunState::Archive archive) const {
    const ConstraintSystem& constraints = getConstraintSystem();
    archive.add("parameters", memory.parameters, constraints.getNumParameters());
    archive.add("parameterRates", memory.parameterRates, constraints.getNumParameters());
    archive.add("multipliers", memory.multipliers, constraints.getNumConstraints());
    archive.add("monitorValue", memory.monitorValue);
    archive.add("lastSubstep", memory.lastSubstep);
}

void LangevinRun::save(RunState& run) const {
    Memory memory = getMemory();
    exchange(memory, RunState::Archive(run));
}

LangevinRun::Memory LangevinRun::read(const RunState& run) const {
    Memory memory = {};
    exchange(memory, RunState::Archive(run));
    return memory;
}

bool LangevinRun::canResume(const RunState& run, const IntegratorSettings&) const {
    read(run);
    return true;
}

void LangevinRun::resume(const vector<Vec3>& positions, const vector<Vec3>& velocities, const vector<Vec3>& forces,
                         double energy, const RunState& run, const IntegratorSettings&) {
    resume(positions, velocities, forces, energy, read(run));
}
