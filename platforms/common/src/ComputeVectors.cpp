// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ComputeVectors.h"
#include "openmm/kernels.h"
#include <cmath>
#include <limits>

using namespace OpenMMVRattle;
using OpenMM::UpdateStateDataKernel;

namespace {

// GPUs add up forces in units of 2^-32 kJ/mol/nm in 64 bits. Beyond this, half of what these can hold, they are taken for no number:
// infinity and what is none become the largest that there is.
const double LARGEST_FORCE = 1 << 30;

} // namespace

ComputeVectors::ComputeVectors(OpenMM::ContextImpl& context, const OpenMM::Integrator& integrator) :
        HostContext(context, integrator),
        kernel(context.getPlatform().createKernel(UpdateStateDataKernel::Name(), context)), numWrites(0) {
    kernel.getAs<UpdateStateDataKernel>().initialize(context.getSystem());
}

const ContextVectors::Vectors& ComputeVectors::getPositions() {
    kernel.getAs<UpdateStateDataKernel>().getPositions(context, positions);
    return positions;
}

const ContextVectors::Vectors& ComputeVectors::getVelocities() {
    kernel.getAs<UpdateStateDataKernel>().getVelocities(context, velocities);
    return velocities;
}

ContextVectors::Vectors& ComputeVectors::getForces() {
    context.getForces(forces);
    for (OpenMM::Vec3& force : forces)
        for (int d = 0; d < 3; d++)
            if (!(std::fabs(force[d]) < LARGEST_FORCE))
                force[d] = std::numeric_limits<double>::quiet_NaN();
    return forces;
}

void ComputeVectors::writePositions(const Writer& write, bool areAll) {
    if (!areAll)
        getPositions();
    positions.resize(context.getSystem().getNumParticles());
    write(positions);
    kernel.getAs<UpdateStateDataKernel>().setPositions(context, positions);
    numWrites++;
}

void ComputeVectors::writeVelocities(const Writer& write, bool areAll) {
    if (!areAll)
        getVelocities();
    velocities.resize(context.getSystem().getNumParticles());
    write(velocities);
    kernel.getAs<UpdateStateDataKernel>().setVelocities(context, velocities);
}

const OpenMM::Vec3* ComputeVectors::getBoxVectors() {
    context.getPeriodicBoxVectors(box[0], box[1], box[2]);
    return box;
}

double ComputeVectors::getTime() {
    return kernel.getAs<UpdateStateDataKernel>().getTime(context);
}

void ComputeVectors::setTime(double time) {
    kernel.getAs<UpdateStateDataKernel>().setTime(context, time);
}

long long ComputeVectors::getStepCount() {
    return kernel.getAs<UpdateStateDataKernel>().getStepCount(context);
}

void ComputeVectors::setStepCount(long long count) {
    kernel.getAs<UpdateStateDataKernel>().setStepCount(context, count);
}
