// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/StartCheck.h"
#include "constraints/StepFailure.h"
#include "openmm/Force.h"
#include "openmm/OpenMMException.h"
#include "step/AutomaticControl.h"
#include <algorithm>
#include <cmath>
#include <numeric>
#include <sstream>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

// A constrained distance counts as met to this fraction, which is more than bonds vibrate by, and no worse than to this
// distance (nm): the longer a constraint is, the sooner some image of a start that is far off would meet it by chance.
const double MET_FRACTION = 0.1, MET_DISTANCE = 0.03;
const char VELOCITIES_HINT[] = "; set velocities with setVelocitiesToTemperature() of the integrator, since the "
                               "Context's uses OpenMM's own constraint solver, which can leave velocities so where "
                               "constraints are strongly coupled";
const char WHOLE_HINT[] =
    ": molecules must be whole, and this one is not; add box vectors to positions until each molecule is in one piece, "
    "as programs that make molecules whole do, or, if it is bonded to its own image, hold the bond through the box by "
    "an "
    "expression that contains the box vector";

bool isFinite(const Vec3& x) {
    return std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2]);
}

double lengthOf(const Vec3& x) {
    return std::sqrt(x.dot(x));
}

// Whether there is a box in which positions may have been wrapped: one that a Force uses, or that is not OpenMM's default.
bool hasPeriodicBox(const OpenMM::System& system, const Vec3* boxVectors) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            if (boxVectors[i][j] != (i == j ? 2.0 : 0.0))
                return true;
    for (int i = 0; i < system.getNumForces(); i++) {
        try {
            if (system.getForce(i).usesPeriodicBoundaryConditions())
                return true;
        }
        catch (const OpenMM::OpenMMException&) {
            // a Force that does not tell
        }
    }
    return false;
}

// But for those of virtual sites, which are computed.
void requirePositions(const OpenMM::System& system, const StartState& state) {
    for (int i = 0; i < system.getNumParticles(); i++)
        if (!system.isVirtualSite(i) && !isFinite(state.positions[i]))
            throw StepFailure("the position of particle " + std::to_string(i) +
                              " is not a finite number; set it before stepping");
}

void requireVelocities(const ConstraintSystem& system, const StartState& state) {
    for (size_t i = 0; i < state.velocities.size(); i++) {
        if (!(system.getInverseMasses()[i] > 0))
            continue;
        const std::string particle = "the velocity of particle " + std::to_string(i);
        if (!isFinite(state.velocities[i]))
            throw StepFailure(particle + " is not a finite number" + VELOCITIES_HINT);
        const double speed = lengthOf(state.velocities[i]);
        if (speed > IMPOSSIBLE_SPEED) {
            std::stringstream reason;
            reason << particle << " is " << speed << " nm/ps, faster than light" << VELOCITIES_HINT;
            throw StepFailure(reason.str());
        }
    }
}

// The shortest of the vectors that differ from r by box vectors. In a box that is not rectangular it need not be the one
// within half a box in each direction, but one beside it.
Vec3 findNearestImage(Vec3 r, const Vec3* box) {
    for (int axis = 2; axis >= 0; axis--)
        r -= box[axis] * std::round(r[axis] / box[axis][axis]);
    Vec3 nearest = r;
    for (int i = -1; i <= 1; i++)
        for (int j = -1; j <= 1; j++)
            for (int k = -1; k <= 1; k++) {
                const Vec3 image = r + box[0] * i + box[1] * j + box[2] * k;
                if (image.dot(image) < nearest.dot(nearest))
                    nearest = image;
            }
    return nearest;
}

void requireWholeDistances(const ConstraintSystem& system, const StartState& state) {
    for (int k = 0; k < system.getNumConstraints(); k++) {
        if (system.isExpression(k))
            continue;
        const DistanceConstraint& c = system.getConstraint(k);
        const Vec3 r = state.positions[c.particle1] - state.positions[c.particle2];
        const double allowed = std::min(MET_FRACTION * c.length, MET_DISTANCE);
        if (std::fabs(lengthOf(r) - c.length) <= allowed)
            continue;
        const double imageDistance = lengthOf(findNearestImage(r, state.boxVectors));
        if (!(std::fabs(imageDistance - c.length) <= allowed))
            continue;
        std::stringstream reason;
        reason << system.describe(k) << " is " << lengthOf(r) << " nm, and to the nearest periodic image "
               << imageDistance << " nm, which meets the length of " << c.length << " nm" << WHOLE_HINT;
        throw StepFailure(reason.str());
    }
}

// The ways in which the particles of an expression may have been meant: each at the image nearest to the first, or to the one
// before it; one particle alone, which an expression holds in space, in the boxes around.
vector<vector<Vec3>> findPlacements(const vector<int>& particles, const StartState& state) {
    vector<vector<Vec3>> placements;
    const Vec3* box = state.boxVectors;
    const Vec3 first = state.positions[particles[0]];
    if (particles.size() == 1) {
        for (int i = -1; i <= 1; i++)
            for (int j = -1; j <= 1; j++)
                for (int k = -1; k <= 1; k++)
                    if (i != 0 || j != 0 || k != 0)
                        placements.push_back({first + box[0] * i + box[1] * j + box[2] * k});
        return placements;
    }
    placements.resize(2, {first});
    for (size_t n = 1; n < particles.size(); n++)
        for (int way = 0; way < 2; way++) {
            const Vec3 from = way == 0 ? first : placements[way].back();
            placements[way].push_back(from + findNearestImage(state.positions[particles[n]] - from, box));
        }
    return placements;
}

// Expressions that are missed, evaluated in each placement of their particles. Each placement has particles of its own, since an
// expression may have a particle at one image and another expression at another.
void requireWholeExpressions(const ConstraintSystem& system, const StartState& state) {
    if (system.getExpressionRows().empty())
        return;
    vector<double> g(system.getNumConstraints());
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    system.evaluateJacobian(state.positions, state.parameters, jacobian);
    system.evaluate(state.positions, state.parameters, g, jacobian);
    vector<double> masses;
    vector<ExpressionConstraint> copies;
    vector<Vec3> positions;
    vector<int> originals; // of each particle: the constraint in the system
    for (const ConstraintSystem::ExpressionRow& row : system.getExpressionRows()) {
        if (system.findErrorOf(row, g, jacobian) <= MET_FRACTION)
            continue;
        ExpressionConstraint copy = system.getExpression(row.constraint, state.parameters);
        const vector<int> particles = copy.particles;
        for (const vector<Vec3>& placement : findPlacements(particles, state)) {
            std::iota(copy.particles.begin(), copy.particles.end(), (int) masses.size());
            copies.push_back(copy);
            positions.insert(positions.end(), placement.begin(), placement.end());
            originals.insert(originals.end(), particles.size(), row.constraint);
            for (int i : particles)
                masses.push_back(system.getMasses()[i]);
        }
    }
    if (copies.empty())
        return;
    const ConstraintSystem images(masses, {}, copies);
    g.resize(images.getNumConstraints());
    jacobian.resize(images.getNumEntries());
    const ExpressionParameters parameters = images.getGivenParameters();
    images.evaluateJacobian(positions, parameters, jacobian);
    images.evaluate(positions, parameters, g, jacobian);
    for (const ConstraintSystem::ExpressionRow& row : images.getExpressionRows())
        if (images.findErrorOf(row, g, jacobian) <= MET_FRACTION)
            throw StepFailure(system.describe(originals[images.getParticleOf(row.first)]) +
                              " does not hold for the positions, and does for periodic images of them" + WHOLE_HINT);
}

} // namespace

void OpenMMVRattle::requireSoundStart(const OpenMM::System& system, const ConstraintSystem& constraints,
                                      const StartState& state) {
    requirePositions(system, state);
    requireVelocities(constraints, state);
    if (!hasPeriodicBox(system, state.boxVectors))
        return;
    requireWholeDistances(constraints, state);
    requireWholeExpressions(constraints, state);
}
