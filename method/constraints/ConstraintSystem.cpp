// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "constraints/ConstraintSystem.h"
#include "constraints/StepFailure.h"
#include "constraints/Sum.h"
#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <sstream>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::vector;

namespace {

double sumSquares(const ConstraintSystem::ExpressionRow& row, const ConstraintSystem::Jacobian& jacobian) {
    double sum = 0;
    for (int entry = row.first; entry < row.end; entry++)
        sum += jacobian[entry].dot(jacobian[entry]);
    return sum;
}

// A motion that changes the gradient of an expression by this fraction of its size is too long for an iteration, and that is a
// matter of singular geometry if it is shorter than the second fraction of the distances between the particles.
const double STRONG_CURVATURE = 0.25, SHARPNESS = 0.1;
// Lengths of a molecule in a line add up but for this fraction, which files may round them by.
const double LINE_ROUNDING = 1e-6;

} // namespace

ExpressionParameters ConstraintSystem::getGivenParameters() const {
    ExpressionParameters theta;
    theta.values.resize(numParameters);
    theta.rates.resize(numParameters);
    for (size_t e = 0; e < expressions.size(); e++)
        writeParameters((int) e, expressions[e].parameters, theta.values);
    return theta;
}

void ConstraintSystem::writeParameters(int expression, const std::map<std::string, double>& parameters,
                                       vector<double>& values) const {
    int place = firstParameters[expression];
    for (const auto& parameter : parameters) // in the order of their names
        values[place++] = parameter.second;
}

// copy(in the order of the constructor, in the internal one) for each parameter
template <class Copy> void ConstraintSystem::forParameters(const Copy& copy) const {
    int given = 0;
    for (size_t e = 0; e < expressions.size(); e++)
        for (size_t i = 0; i < expressions[e].parameters.size(); i++)
            copy(given++, firstParameters[e] + (int) i);
}

ExpressionParameters ConstraintSystem::toGivenOrder(const ExpressionParameters& theta) const {
    ExpressionParameters given = theta;
    forParameters([&](int to, int from) {
        given.values[to] = theta.values[from];
        given.rates[to] = theta.rates[from];
    });
    return given;
}

ExpressionParameters ConstraintSystem::fromGivenOrder(const ExpressionParameters& given) const {
    ExpressionParameters theta = given;
    forParameters([&](int from, int to) {
        theta.values[to] = given.values[from];
        theta.rates[to] = given.rates[from];
    });
    return theta;
}

ExpressionConstraint ConstraintSystem::getExpression(int index, const ExpressionParameters& theta) const {
    const int e = expressionOf(index);
    ExpressionConstraint result = expressions[e];
    int place = firstParameters[e];
    for (auto& parameter : result.parameters)
        parameter.second = theta.values[place++];
    return result;
}

void ConstraintSystem::findParameterChange(const vector<Vec3>& q, const ExpressionParameters& theta,
                                           const vector<double>& target, vector<double>& change) const {
    for (int i = 0; i < numParameters; i++)
        change[i] = target[i] - theta.values[i];
    ExpressionParameters there = theta, along = theta;
    there.values = target;
    there.rates = along.rates = change;
    there.isMoving = along.isMoving = true;
    vector<double> before(getNumConstraints()), after(before), linear(before), linearThere(before);
    forGroups(ALL, [&](const ExpressionGroup& group, int first, int end) {
        group.evaluate(q, theta, before, first, end);
        group.evaluate(q, there, after, first, end);
        group.addParameterMotion(q, along, linear, first, end);
        group.addParameterMotion(q, there, linearThere, first, end);
    });
    for (const ExpressionRow& row : expressionRows) {
        const double ratio = (after[row.constraint] - before[row.constraint]) / linear[row.constraint];
        // A period, after which g changes as before; the mere curvature of g would make it change the other way.
        if (!(ratio < 0.5 && linearThere[row.constraint] / linear[row.constraint] > 0.5))
            continue;
        const int e = expressionOf(row.constraint), first = firstParameters[e];
        for (size_t i = 0; i < expressions[e].parameters.size(); i++)
            change[first + i] *= ratio;
    }
}

std::string ConstraintSystem::describe(int index) const {
    if (!isExpression(index))
        return "the constrained distance between the particles " + std::to_string(constraints[index].particle1) +
               " and " + std::to_string(constraints[index].particle2);
    const int e = expressionOf(index);
    return "expression constraint " + std::to_string(e) + " (" + expressions[e].expression + " = 0) of " +
           listParticles(expressions[e].particles);
}

std::string ConstraintSystem::explainGradient(int index, const Jacobian& jacobian) const {
    if (!isExpression(index)) {
        const DistanceConstraint& c = constraints[index];
        return jacobian[index].dot(jacobian[index]) > 0
                   ? ""
                   : "the particles " + std::to_string(c.particle1) + " and " + std::to_string(c.particle2) +
                         " are at the same position, so that the distance at which a constraint holds them has no "
                         "direction; set other positions";
    }
    const double square = sumSquares(findRow(index), jacobian);
    if (square > 0 && std::isfinite(square))
        return "";
    return "the gradient of " + describe(index) +
           (square == 0
                ? " is zero, so that it can be held by no force; choose other positions, or write it such that its "
                  "gradient does not vanish where it holds"
                : " is not finite at these positions; choose others, or write it such that it has a derivative "
                  "where it holds");
}

std::string ConstraintSystem::explainResolution(int index, const vector<Vec3>& q, double tolerance) const {
    double largest = 0;
    for (int i : getParticles(index))
        for (int axis = 0; axis < 3; axis++)
            largest = std::max(largest, std::fabs(q[i][axis]));
    const double spacing = std::numeric_limits<double>::epsilon() * largest;
    const double length = isExpression(index) ? EXPRESSION_LENGTH : constraints[index].length;
    if (!(spacing > tolerance * length))
        return "";
    std::stringstream text;
    text << describe(index) << " cannot be met to a fraction of " << tolerance << " of " << length
         << " nm by positions as large as " << largest << " nm, which are rounded to " << spacing
         << " nm; bring the particles nearer to the origin, or raise the constraint tolerance";
    return text.str();
}

std::string ConstraintSystem::explainLine(int cluster) const {
    std::map<int, std::map<int, double>> lengths; // from each particle to others
    const int first = clusters[cluster].first, end = first + clusters[cluster].size;
    for (int k = first; k < end; k++)
        if (!isExpression(k)) {
            const DistanceConstraint& c = constraints[k];
            lengths[c.particle1][c.particle2] = lengths[c.particle2][c.particle1] = c.length;
        }
    for (const auto& [one, toOthers] : lengths)
        for (const auto& [other, whole] : toOthers)
            for (const auto& [middle, part] : toOthers) {
                const auto rest = lengths[other].find(middle);
                if (rest == lengths[other].end() || !(std::fabs(part + rest->second - whole) <= LINE_ROUNDING * whole))
                    continue;
                return "the distances among the particles " + std::to_string(one) + ", " + std::to_string(middle) +
                       " and " + std::to_string(other) +
                       " keep them in a line, where they depend on each other: hold the middle one there by three "
                       "expressions in place of its distances, such as x2 - 0.5*(x1+x3), likewise y and z "
                       "(docs/constraints.md, molecules in a line)";
            }
    return "";
}

vector<int> ConstraintSystem::getParticles(int index) const {
    if (isExpression(index))
        return expressions[expressionOf(index)].particles;
    return {constraints[index].particle1, constraints[index].particle2};
}

vector<int> ConstraintSystem::getClusterParticles(int cluster) const {
    std::set<int> particles;
    for (int k = clusters[cluster].first; k < clusters[cluster].first + clusters[cluster].size; k++)
        for (int i : getParticles(k))
            particles.insert(i);
    return vector<int>(particles.begin(), particles.end());
}

double ConstraintSystem::findErrorOf(const ExpressionRow& row, const vector<double>& g, const Jacobian& nearby) const {
    return std::fabs(g[row.constraint]) / (std::sqrt(sumSquares(row, nearby)) * EXPRESSION_LENGTH);
}

// Do something for each distance constraint of a part.
template <class Task> void ConstraintSystem::forDistances(const Part& part, const Task& task) const {
    auto stretch = std::upper_bound(distanceStretches.begin(), distanceStretches.end(), part.first,
                                    [](int k, const Stretch& each) { return k < each.end; });
    for (; stretch != distanceStretches.end() && stretch->first < part.end; ++stretch) {
        const int end = std::min(part.end, stretch->end);
        for (int k = std::max(part.first, stretch->first); k < end; k++)
            task(k);
    }
}

// Do something for the row of each expression of a part.
template <class Task> void ConstraintSystem::forRows(const Part& part, const Task& task) const {
    const int end = std::min(part.endRow, (int) expressionRows.size());
    for (int r = part.firstRow; r < end; r++)
        task(expressionRows[r]);
}

// Do something for the expressions of a part, group by group.
template <class Task> void ConstraintSystem::forGroups(const Part& part, const Task& task) const {
    const int end = part.endGroupRange == ALL.endGroupRange ? (int) groups.size() : part.endGroupRange;
    for (int r = part.firstGroupRange; r < end; r++)
        task(*groups[groupRanges[r].group], groupRanges[r].first, groupRanges[r].end);
}

// The row of a constraint that is an expression.
const ConstraintSystem::ExpressionRow& ConstraintSystem::findRow(int constraint) const {
    return *std::lower_bound(expressionRows.begin(), expressionRows.end(), constraint,
                             [](const ExpressionRow& row, int k) { return row.constraint < k; });
}

double ConstraintSystem::evaluate(const vector<Vec3>& q, const ExpressionParameters& theta, vector<double>& g,
                                  const Jacobian& nearby, const Part& part) const {
    double largest = 0;
    forDistances(part, [&](int k) {
        Vec3 r = q[constraints[k].particle1] - q[constraints[k].particle2];
        double length = constraints[k].length;
        g[k] = 0.5 * (r.dot(r) - length * length) * inverseSquareLengths[k];
        largest = largerOf(largest, std::fabs(g[k]));
    });
    forGroups(part, [&](const ExpressionGroup& group, int first, int end) { group.evaluate(q, theta, g, first, end); });
    forRows(part, [&](const ExpressionRow& row) { largest = largerOf(largest, findErrorOf(row, g, nearby)); });
    return largest;
}

int ConstraintSystem::findLargest(const vector<double>& g, const Jacobian& nearby) const {
    vector<double> errors = g;
    for (const ExpressionRow& row : expressionRows)
        errors[row.constraint] = findErrorOf(row, g, nearby);
    int largest = 0;
    for (int k = 1; k < getNumConstraints(); k++)
        if (!(std::fabs(errors[k]) <= std::fabs(errors[largest])))
            largest = k;
    return largest;
}

int ConstraintSystem::findSingular(const vector<Vec3>& q, const ExpressionParameters& theta,
                                   const vector<Vec3>& displacement, const Jacobian& jacobian,
                                   Jacobian& velocityJacobian) const {
    ExpressionParameters atRest = theta;
    atRest.isMoving = false;
    evaluateVelocityJacobian(q, displacement, atRest, velocityJacobian);
    int singular = NONE;
    double largest = STRONG_CURVATURE;
    for (const ExpressionRow& row : expressionRows) {
        const vector<int>& particles = expressions[expressionOf(row.constraint)].particles;
        const bool holdsFixed = row.end - row.first < (int) particles.size();
        Vec3 centre, shift;
        for (int i : particles) {
            centre += q[i] / (double) particles.size();
            if (particles.size() > 1 && !holdsFixed) // else its motion as a whole is no motion within it
                shift += displacement[i] / (double) particles.size();
        }
        double radius = EXPRESSION_LENGTH * EXPRESSION_LENGTH, path = 0; // squared
        for (int entry = row.first; entry < row.end; entry++) {
            const int i = getParticleOf(entry);
            const Vec3 r = q[i] - centre, d = displacement[i] - shift;
            radius = std::max(radius, r.dot(r));
            path = std::max(path, d.dot(d));
        }
        const double curvature = std::sqrt(sumSquares(row, velocityJacobian) / sumSquares(row, jacobian));
        // Over a length of the size of its particles' distances the gradient of any expression turns.
        const bool isSharp = !(path >= SHARPNESS * SHARPNESS * curvature * curvature * radius);
        if (std::isnan(curvature))
            return row.constraint;
        if (isSharp && curvature > largest) {
            largest = curvature;
            singular = row.constraint;
        }
    }
    return singular;
}

// The distance constraints' part of G(x).
void ConstraintSystem::evaluateDistanceRows(const vector<Vec3>& x, Jacobian& jacobian, const Part& part) const {
    forDistances(part, [&](int k) {
        jacobian[k] = (x[constraints[k].particle1] - x[constraints[k].particle2]) * inverseSquareLengths[k];
    });
}

void ConstraintSystem::evaluateJacobian(const vector<Vec3>& q, const ExpressionParameters& theta, Jacobian& jacobian,
                                        const Part& part) const {
    evaluateDistanceRows(q, jacobian, part);
    forGroups(part, [&](const ExpressionGroup& group, int first, int end) {
        group.evaluateJacobian(q, theta, jacobian, first, end);
    });
}

void ConstraintSystem::addParameterMotion(const vector<Vec3>& q, const ExpressionParameters& theta,
                                          vector<double>& result, const Part& part) const {
    if (theta.isMoving)
        forGroups(part, [&](const ExpressionGroup& group, int first, int end) {
            group.addParameterMotion(q, theta, result, first, end);
        });
}

void ConstraintSystem::evaluateVelocityJacobian(const vector<Vec3>& q, const vector<Vec3>& v,
                                                const ExpressionParameters& theta, Jacobian& jacobian,
                                                const Part& part) const {
    evaluateDistanceRows(v, jacobian, part);
    forGroups(part, [&](const ExpressionGroup& group, int first, int end) {
        group.evaluateVelocityJacobian(q, v, theta, jacobian, first, end);
    });
}

void ConstraintSystem::multiply(const Jacobian& jacobian, const vector<Vec3>& w, vector<double>& result,
                                const Part& part) const {
    forDistances(
        part, [&](int k) { result[k] = jacobian[k].dot(w[constraints[k].particle1] - w[constraints[k].particle2]); });
    forRows(part, [&](const ExpressionRow& row) {
        double sum = 0;
        for (int entry = row.first; entry < row.end; entry++)
            sum += jacobian[entry].dot(w[getParticleOf(entry)]);
        result[row.constraint] = sum;
    });
}

void ConstraintSystem::multiplyOverMass(const Jacobian& jacobian, const vector<Vec3>& f, vector<double>& result,
                                        const Part& part) const {
    forDistances(part, [&](int k) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        result[k] = jacobian[k].dot(f[i] * inverseMasses[i] - f[j] * inverseMasses[j]);
    });
    forRows(part, [&](const ExpressionRow& row) {
        double sum = 0;
        for (int entry = row.first; entry < row.end; entry++) {
            const int i = getParticleOf(entry);
            sum += jacobian[entry].dot(f[i]) * inverseMasses[i];
        }
        result[row.constraint] = sum;
    });
}

void ConstraintSystem::addTransposed(const Jacobian& jacobian, const vector<double>& x, vector<Vec3>& result,
                                     const Part& part) const {
    forDistances(part, [&](int k) {
        Vec3 force = jacobian[k] * x[k];
        result[constraints[k].particle1] += force;
        result[constraints[k].particle2] -= force;
    });
    forRows(part, [&](const ExpressionRow& row) {
        for (int entry = row.first; entry < row.end; entry++)
            result[getParticleOf(entry)] += jacobian[entry] * x[row.constraint];
    });
}

void ConstraintSystem::addTransposedOverMass(const Jacobian& jacobian, const vector<double>& x, double scale,
                                             vector<Vec3>& result, const Part& part) const {
    forDistances(part, [&](int k) {
        int i = constraints[k].particle1, j = constraints[k].particle2;
        Vec3 force = jacobian[k] * (scale * x[k]);
        result[i] += force * inverseMasses[i];
        result[j] -= force * inverseMasses[j];
    });
    forRows(part, [&](const ExpressionRow& row) {
        for (int entry = row.first; entry < row.end; entry++) {
            const int i = getParticleOf(entry);
            result[i] += jacobian[entry] * (scale * x[row.constraint] * inverseMasses[i]);
        }
    });
    for (int e = part.firstJointEnd; e < part.endJointEnd; e++) {
        const JointEnd& end = jointEnds[e];
        result[end.particle] +=
            jacobian[end.entry] * (end.sign * scale * x[end.constraint] * inverseMasses[end.particle]);
    }
}

void ConstraintSystem::evaluateCurvature(const vector<Vec3>& q, const vector<Vec3>& v,
                                         const ExpressionParameters& theta, vector<double>& result,
                                         const Part& part) const {
    forDistances(part, [&](int k) {
        Vec3 w = v[constraints[k].particle1] - v[constraints[k].particle2];
        result[k] = w.dot(w) * inverseSquareLengths[k];
    });
    forGroups(part, [&](const ExpressionGroup& group, int first, int end) {
        group.evaluateCurvature(q, v, theta, result, first, end);
    });
}

void ConstraintSystem::getGivenMultipliers(const vector<double>& multipliers, vector<double>& result) const {
    result.assign(numGivenConstraints, 0.0);
    for (int k = 0; k < getNumConstraints(); k++)
        result[givenIndex[k]] = multipliers[k] * multiplierFactors[k];
}

double ConstraintSystem::getExpressionMultiplier(int expression, const vector<double>& multipliers) const {
    const auto isWanted = [&](const ExpressionRow& row) {
        return givenIndex[row.constraint] == numGivenDistances + expression;
    };
    const int k = std::find_if(expressionRows.begin(), expressionRows.end(), isWanted)->constraint;
    return multipliers[k] * multiplierFactors[k];
}
