// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// Constraints given as expressions: values and derivatives of random expressions against Lepton's and against differences; the
// rows of mixed systems against dense algebra; the fill of a rod and of a fixed centre of mass.

#include "TestSupport.h"
#include "constraints/ConstraintMatrix.h"
#include "constraints/EliminationOrder.h"
#include "constraints/NewtonMatrix.h"
#include "expressions/ExpressionGroup.h"
#include "lepton/ParsedExpression.h"
#include "lepton/Parser.h"
#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <random>

using namespace OpenMMVRattle;
using OpenMM::Vec3;
using std::map;
using std::string;
using std::vector;

namespace {

std::mt19937 generator(2026);

double uniform(double from, double to) {
    return std::uniform_real_distribution<double>(from, to)(generator);
}

int pick(int count) {
    return std::uniform_int_distribution<int>(0, count - 1)(generator);
}

Vec3 randomVector() {
    return Vec3(uniform(-1, 1), uniform(-1, 1), uniform(-1, 1));
}

const int NUM_PARTICLES = 3;
const char* const AXES[] = {"x", "y", "z"};

string coordinate(int i) {
    return AXES[i % 3] + std::to_string(i / 3 + 1);
}

// A random expression whose functions stay inside their domains, so that differences are a measure.
string makeSmooth(int depth) {
    if (depth == 0)
        switch (pick(6)) {
        case 0:
            return std::to_string(uniform(-2, 2));
        case 1:
            return pick(2) ? "k" : "shift";
        default:
            return coordinate(pick(3 * NUM_PARTICLES));
        }
    const string a = makeSmooth(depth - 1), b = makeSmooth(depth - 1), small = "tanh(" + a + ")";
    const vector<string> forms = {
        "(" + a + "+" + b + ")",
        "(" + a + "-" + b + ")",
        a + "*" + b,
        "(" + a + ")/(1.5+tanh(" + b + "))",
        "-(" + a + ")",
        "(" + a + ")^2",
        "(" + a + ")^3",
        "(1.2+0.5*" + small + ")^(-2)",
        "(1.2+0.5*" + small + ")^1.7",
        "(1.2+0.5*" + small + ")^(0.3*" + b + ")",
        "(0.9+0.1*" + small + ")^20",
        "1.7^(0.4*" + small + ")",
        "sqrt(1+(" + a + ")^2)",
        "exp(0.5*" + small + ")",
        "log(1.5+" + small + ")",
        "sin(" + a + ")",
        "cos(" + a + ")",
        "sec(" + small + ")",
        "csc(1.6+" + small + ")",
        "tan(" + small + ")",
        "cot(1.6+" + small + ")",
        "asin(0.8*" + small + ")",
        "acos(0.8*" + small + ")",
        "atan(" + a + ")",
        "atan2(" + a + ",1.5+tanh(" + b + "))",
        "atan2(2+" + small + "," + b + ")",
        "sinh(" + small + ")",
        "cosh(" + small + ")",
        "tanh(" + a + ")",
        "erf(" + a + ")",
        "erfc(" + a + ")",
        "square(" + a + ")",
        "cube(" + small + ")",
        "recip(1.4+" + small + ")",
    };
    return forms[pick((int) forms.size())];
}

// With kinks and jumps, where differences mean nothing.
string makePiecewise(int depth) {
    const string a = makeSmooth(depth), b = makeSmooth(depth), c = makeSmooth(depth);
    const vector<string> forms = {"min(" + a + "," + b + ")*" + c,
                                  "max(" + a + "," + b + ")+" + c,
                                  "abs(" + a + ")*" + b,
                                  "floor(3*" + a + ")*" + b,
                                  "ceil(3*" + a + ")+" + b,
                                  "step(" + a + ")*" + b,
                                  "delta(" + a + ")+" + b,
                                  "select(step(" + a + ")," + b + "," + c + ")",
                                  "select(" + a + "," + b + "," + c + ")"};
    return "w*" + forms[pick((int) forms.size())] + "; w = " + makeSmooth(1);
}

struct Sample {
    explicit Sample(const string& expression) : constraint{expression, {2, 0, 1}, {{"k", 0.7}, {"shift", -0.4}}} {
        for (int i = 0; i < NUM_PARTICLES; i++) {
            positions.push_back(randomVector());
            velocities.push_back(randomVector());
        }
        group.reset(new ExpressionGroup(constraint));
        group->add(constraint, 0, 0, 0, {1, 1, 1});
        group->compile();
        theta.values = {0.7, -0.4};
        theta.rates = {0, 0};
    }
    double& at(vector<Vec3>& x, int variable) const {
        return x[constraint.particles[variable / 3]][variable % 3];
    }
    map<string, double> variables() {
        map<string, double> result = constraint.parameters;
        for (int i = 0; i < 3 * NUM_PARTICLES; i++)
            result[coordinate(i)] = at(positions, i);
        return result;
    }
    double value(const vector<Vec3>& x) {
        vector<double> g(1);
        group->evaluate(x, theta, g, 0, 1);
        return g[0];
    }
    double curvature(const vector<Vec3>& v) {
        vector<double> result(1);
        group->evaluateCurvature(positions, v, theta, result, 0, 1);
        return result[0];
    }
    vector<double> inOrder(const vector<Vec3>& rows) {
        vector<double> result;
        for (int i = 0; i < 3 * NUM_PARTICLES; i++)
            result.push_back(rows[i / 3][i % 3]);
        return result;
    }
    vector<double> gradient(const vector<Vec3>& x) {
        vector<Vec3> rows(NUM_PARTICLES);
        group->evaluateJacobian(x, theta, rows, 0, 1);
        return inOrder(rows);
    }
    vector<double> velocityRow(const vector<Vec3>& v) {
        vector<Vec3> rows(NUM_PARTICLES);
        group->evaluateVelocityJacobian(positions, v, theta, rows, 0, 1);
        return inOrder(rows);
    }
    ExpressionConstraint constraint;
    ExpressionParameters theta;
    vector<Vec3> positions, velocities;
    std::unique_ptr<ExpressionGroup> group;
};

void assertNear(double expected, double found, double scale, double tolerance, const string& expression) {
    const bool areBothNaN = std::isnan(expected) && std::isnan(found);
    if (expected != found && !areBothNaN && !(std::fabs(expected - found) <= tolerance * (std::fabs(scale) + 1)))
        throw OpenMM::OpenMMException(expression + ": expected " + std::to_string(expected) + ", found " +
                                      std::to_string(found));
}

double largest(const vector<double>& numbers) {
    double result = 0;
    for (double x : numbers)
        result = std::max(result, std::fabs(x));
    return result;
}

// Values, gradient, (d^2g/dq^2 v) and g''(v,v) against Lepton's own derivatives, evaluated by Lepton.
void compareWithLepton(const string& expression) {
    Sample sample(expression);
    const map<string, double> variables = sample.variables();
    const double value = Lepton::Parser::parse(expression).evaluate(variables);
    // Before it is optimized, x^2 has the derivative of x^y, with a logarithm.
    const Lepton::ParsedExpression parsed = Lepton::Parser::parse(expression).optimize();
    assertNear(value, sample.value(sample.positions), value, 1e-12, expression);
    const vector<double> gradient = sample.gradient(sample.positions), row = sample.velocityRow(sample.velocities);
    const double gradientScale = largest(gradient), rowScale = largest(row);
    double curvature = 0;
    for (int i = 0; i < 3 * NUM_PARTICLES; i++) {
        const Lepton::ParsedExpression derivative = parsed.differentiate(coordinate(i));
        assertNear(derivative.evaluate(variables), gradient[i], gradientScale, 1e-11, expression);
        double sum = 0;
        for (int j = 0; j < 3 * NUM_PARTICLES; j++)
            sum += derivative.differentiate(coordinate(j)).evaluate(variables) * sample.at(sample.velocities, j);
        assertNear(sum, row[i], rowScale, 1e-10, expression);
        curvature += sum * sample.at(sample.velocities, i);
    }
    assertNear(curvature, sample.curvature(sample.velocities), rowScale, 1e-10, expression);
}

// The derivative of f at 0 by central differences of fourth order.
template <class Function> double differentiate(const Function& f) {
    const double h = 1e-4;
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h);
}

void compareWithDifferences(const string& expression) {
    Sample sample(expression);
    const vector<double> gradient = sample.gradient(sample.positions), row = sample.velocityRow(sample.velocities);
    const double value = sample.value(sample.positions), scale = largest(gradient) + std::fabs(value);
    auto moved = [&](const vector<Vec3>& velocities, double t) {
        vector<Vec3> result = sample.positions;
        for (int p = 0; p < NUM_PARTICLES; p++)
            result[p] += velocities[p] * t;
        return result;
    };
    double curvature = 0;
    for (int i = 0; i < 3 * NUM_PARTICLES; i++) {
        vector<Vec3> axis(NUM_PARTICLES);
        sample.at(axis, i) = 1;
        const double alongAxis = differentiate([&](double t) { return sample.value(moved(axis, t)); });
        assertNear(alongAxis, gradient[i], scale, 1e-7, expression);
        // The row is the derivative of the gradient along v, and half the derivative of g''(v,v) with respect to v.
        const double alongVelocity =
            differentiate([&](double t) { return sample.gradient(moved(sample.velocities, t))[i]; });
        assertNear(alongVelocity, row[i], largest(row) + scale, 1e-7, expression);
        vector<Vec3> faster = sample.velocities, slower = sample.velocities;
        sample.at(faster, i) += 1;
        sample.at(slower, i) -= 1;
        const double half = (sample.curvature(faster) - sample.curvature(slower)) / 4;
        assertNear(half, row[i], largest(row) + scale, 1e-10, expression);
        curvature += row[i] * sample.at(sample.velocities, i);
    }
    assertNear(curvature, sample.curvature(sample.velocities), largest(row) + scale, 1e-11, expression);
}

} // namespace

void testRandomExpressions() {
    for (int i = 0; i < 300; i++) // Lepton's second derivatives of deeper ones take minutes
        compareWithLepton(makeSmooth(1 + i % 2));
}

void testRandomDifferences() {
    for (int i = 0; i < 1000; i++)
        compareWithDifferences(makeSmooth(1 + i % 4));
}

void testPiecewiseExpressions() {
    for (int i = 0; i < 120; i++)
        compareWithLepton(makePiecewise(1));
}

void testSpecialExpressions() {
    for (const char* expression : {"x1",
                                   "3",
                                   "-y2",
                                   "x1-x1",
                                   "x1*0",
                                   "2*3*x1",
                                   "x1^1",
                                   "x1^0",
                                   "x1^0.5+x2^2.5",
                                   "x1^(-1)",
                                   "x1^16+x1^17",
                                   "a*a; a = b*b; b = x1+y1",
                                   "(x1+y1)*(x1+y1)/(x1+y1)",
                                   "x1*y1*z1*x2*y2*z2*x3*y3*z3",
                                   "1/(1/(1/x1))",
                                   "-(-(-x1*(-y1)))",
                                   "select(1, x1, log(-1-x1^2))",
                                   "k*k+shift",
                                   "sqrt(k)*x1",
                                   "min(3, 4)*x1"})
        compareWithLepton(expression);
}

// A branch of select() that is not taken has no part in anything, though it be infinite or not a number.
void testGuards() {
    Sample sample("select(step(x1), sqrt(x1), x1^2) + select(step(-y1), 1, 1/(y1-y1)*0 + log(y1)) - 0.3*z1");
    sample.at(sample.positions, 0) = -1.5;
    sample.at(sample.positions, 1) = -0.5;
    sample.at(sample.velocities, 0) = 2;
    ASSERT_EQUAL_TOL(2.25 + 1 - 0.3 * sample.at(sample.positions, 2), sample.value(sample.positions), 1e-14);
    const vector<double> gradient = sample.gradient(sample.positions), row = sample.velocityRow(sample.velocities);
    ASSERT_EQUAL_TOL(-3.0, gradient[0], 1e-14);
    ASSERT_EQUAL(0.0, gradient[1]);
    ASSERT_EQUAL_TOL(-0.3, gradient[2], 1e-14);
    ASSERT_EQUAL_TOL(4.0, row[0], 1e-14);
    ASSERT_EQUAL(0.0, row[1]);
    ASSERT_EQUAL_TOL(8.0, sample.curvature(sample.velocities), 1e-14);
}

// Each of many constraints that share an expression has the same bits as if it were alone.
void testGroups() {
    for (int count : {1, 2, 63, 64, 65, 129, 200}) {
        const ExpressionConstraint example = {
            "atan2(y1-y2, x1-x2) + k*sqrt((z1-z2)^2+d) - exp(-r); r = (x1-x2)^2+(y1-y2)^2",
            {0, 1},
            {{"k", 1}, {"d", 2}}};
        vector<Vec3> q, v;
        vector<double> inverseMasses;
        vector<ExpressionConstraint> constraints;
        for (int i = 0; i < count; i++) {
            ExpressionConstraint c = example;
            c.particles = {2 * i + 1, 2 * i};
            c.parameters["k"] = uniform(0.5, 1);
            constraints.push_back(c);
            for (int p = 0; p < 2; p++) {
                q.push_back(randomVector());
                v.push_back(randomVector());
                inverseMasses.push_back(p == 0 && i % 3 == 0 ? 0.0 : 1.0);
            }
        }
        ExpressionGroup together(example);
        for (int i = 0; i < count; i++)
            together.add(constraints[i], count - 1 - i, 2 * i, 2 * i, inverseMasses);
        together.compile();
        ExpressionParameters theta;
        for (int i = 0; i < count; i++)
            for (const char* name : {"d", "k"})
                theta.values.push_back(constraints[i].parameters.at(name));
        vector<double> g(count), curvature(count);
        vector<Vec3> rows(2 * count), velocityRows(2 * count);
        const int cut = count / 3; // in two ranges
        for (const auto& range : {std::make_pair(0, cut), std::make_pair(cut, count)}) {
            together.evaluate(q, theta, g, range.first, range.second);
            together.evaluateCurvature(q, v, theta, curvature, range.first, range.second);
            together.evaluateJacobian(q, theta, rows, range.first, range.second);
            together.evaluateVelocityJacobian(q, v, theta, velocityRows, range.first, range.second);
        }
        for (int i = 0; i < count; i++) {
            ExpressionGroup alone(constraints[i]);
            alone.add(constraints[i], 0, 0, 0, inverseMasses);
            alone.compile();
            const ExpressionParameters own{{theta.values[2 * i], theta.values[2 * i + 1]}, {}, false};
            vector<double> number(1);
            vector<Vec3> row(2), velocityRow(2);
            alone.evaluate(q, own, number, 0, 1);
            ASSERT_EQUAL(number[0], g[count - 1 - i]);
            alone.evaluateCurvature(q, v, own, number, 0, 1);
            ASSERT_EQUAL(number[0], curvature[count - 1 - i]);
            alone.evaluateJacobian(q, own, row, 0, 1);
            alone.evaluateVelocityJacobian(q, v, own, velocityRow, 0, 1);
            for (int p = 0; p < 2; p++) {
                ASSERT(row[p] == rows[2 * i + p]);
                ASSERT(velocityRow[p] == velocityRows[2 * i + p]);
            }
            // A particle without mass has no part in the row, and its velocity none in anything.
            if (i % 3 == 0)
                ASSERT(row[1] == Vec3() && velocityRow[1] == Vec3());
            if (i % 3 == 0) {
                v[2 * i] = Vec3(5, 5, 5);
                const double before = number[0];
                alone.evaluateCurvature(q, v, own, number, 0, 1);
                ASSERT_EQUAL(before, number[0]);
            }
        }
    }
}

// --------------------------------------------------------------------------------------------- in a constraint system

namespace {

const string ANGLE = "acos(((x1-x2)*(x3-x2)+(y1-y2)*(y3-y2)+(z1-z2)*(z3-z2))/sqrt(a*b))-angle;"
                     "a=(x1-x2)^2+(y1-y2)^2+(z1-z2)^2; b=(x3-x2)^2+(y3-y2)^2+(z3-z2)^2";

// Waters, chains and lone particles, some of them held by planes, angles, anchors and a centre of mass.
struct MixedSystem {
    explicit MixedSystem(int chainLength) {
        auto addParticles = [&](int count) {
            for (int i = 0; i < count; i++) {
                masses.push_back(uniform(1, 150));
                positions.push_back(randomVector());
                velocities.push_back(randomVector());
            }
            return (int) masses.size() - count;
        };
        auto constrain = [&](int i, int j) {
            const Vec3 r = positions[i] - positions[j];
            distances.push_back({i, j, std::sqrt(r.dot(r))});
        };
        for (int molecule = 0; molecule < 4; molecule++) {
            const int first = addParticles(3);
            constrain(first, first + 1);
            constrain(first, first + 2);
            constrain(first + 1, first + 2);
        }
        expressions.push_back({"nx*x1+ny*y1+z1-d", {0}, {{"nx", 0.3}, {"ny", -0.2}, {"d", 0.1}}}); // of the first water
        const int chain = addParticles(chainLength);
        for (int i = 1; i < chainLength; i++)
            constrain(chain + i - 1, chain + i);
        for (int i = 0; i + 2 < chainLength; i += 2)
            expressions.push_back({ANGLE, {chain + i, chain + i + 1, chain + i + 2}, {{"angle", 1.9}}});
        const int lone = addParticles(3), anchor = addParticles(2);
        masses[anchor] = masses[anchor + 1] = 0;
        expressions.push_back({"(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-1", {anchor, lone}, {}});
        for (const char* axis : AXES)
            expressions.push_back({axis + string("1*2+") + axis + "2*3", {lone + 1, lone + 2}, {}});
        expressions.push_back({"(x1-x2)^2+(y1-y2)^2+(z1-z2)^2-1", {chain, anchor + 1}, {}}); // a chain that hangs
        std::shuffle(distances.begin(), distances.end(), generator);
    }
    vector<double> masses;
    vector<DistanceConstraint> distances;
    vector<ExpressionConstraint> expressions;
    vector<Vec3> positions, velocities;
};

Eigen::VectorXd flatten(const vector<Vec3>& x) {
    Eigen::VectorXd result(3 * x.size());
    for (int i = 0; i < result.size(); i++)
        result[i] = x[i / 3][i % 3];
    return result;
}

Eigen::VectorXd flattenNumbers(const vector<double>& x) {
    return Eigen::VectorXd::Map(x.data(), x.size());
}

Eigen::VectorXd denseInverseMasses(const vector<double>& masses) {
    Eigen::VectorXd result(3 * masses.size());
    for (int i = 0; i < result.size(); i++)
        result[i] = masses[i / 3] > 0 ? 1 / masses[i / 3] : 0;
    return result;
}

// The Jacobian by differences of g itself.
Eigen::MatrixXd denseJacobian(const ConstraintSystem& system, const vector<Vec3>& q) {
    const double h = 1e-6;
    const ExpressionParameters theta = system.getGivenParameters();
    ConstraintSystem::Jacobian nearby(system.getNumEntries());
    system.evaluateJacobian(q, theta, nearby);
    vector<double> plus(system.getNumConstraints()), minus(system.getNumConstraints());
    Eigen::MatrixXd result(system.getNumConstraints(), 3 * q.size());
    for (size_t i = 0; i < 3 * q.size(); i++) {
        vector<Vec3> ahead = q, back = q;
        ahead[i / 3][i % 3] += h;
        back[i / 3][i % 3] -= h;
        system.evaluate(ahead, theta, plus, nearby);
        system.evaluate(back, theta, minus, nearby);
        result.col(i) = (flattenNumbers(plus) - flattenNumbers(minus)) / (2 * h);
    }
    return result;
}

void assertClose(const Eigen::VectorXd& expected, const Eigen::VectorXd& found, double tolerance) {
    ASSERT((expected - found).norm() <= tolerance * expected.norm());
}

} // namespace

void testAgainstDense(int chainLength) {
    MixedSystem e(chainLength);
    ConstraintSystem system(e.masses, e.distances, e.expressions);
    const ExpressionParameters theta = system.getGivenParameters();
    const int m = system.getNumConstraints();
    ASSERT_EQUAL((int) (e.distances.size() + e.expressions.size()), m);
    ASSERT_EQUAL(9, system.getFirstGeneral()); // the three waters without an expression
    const Eigen::VectorXd inverseMasses = denseInverseMasses(e.masses);
    const Eigen::MatrixXd dense = denseJacobian(system, e.positions);
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    system.evaluateJacobian(e.positions, theta, jacobian);

    vector<double> result(m);
    system.multiply(jacobian, e.velocities, result);
    // The anchors have velocities here, which mean nothing.
    vector<Vec3> moving = e.velocities;
    for (size_t i = 0; i < moving.size(); i++)
        if (e.masses[i] == 0)
            moving[i] = Vec3();
    vector<double> movingResult(m);
    system.multiply(jacobian, moving, movingResult);
    assertClose(dense * flatten(moving), flattenNumbers(movingResult), 1e-7);
    system.multiplyOverMass(jacobian, e.velocities, result);
    assertClose(dense * inverseMasses.asDiagonal() * flatten(e.velocities), flattenNumbers(result), 1e-7);
    vector<double> x(m);
    for (double& number : x)
        number = uniform(-1, 1);
    vector<Vec3> sum(e.masses.size());
    system.addTransposedOverMass(jacobian, x, 0.5, sum);
    assertClose(0.5 * (inverseMasses.asDiagonal() * dense.transpose() * flattenNumbers(x)), flatten(sum), 1e-7);
    vector<Vec3> forces(e.masses.size());
    system.addTransposed(jacobian, x, forces);
    for (size_t i = 0; i < forces.size(); i++)
        if (e.masses[i] == 0)
            forces[i] = Vec3(); // on what cannot move
    Eigen::VectorXd expected = dense.transpose() * flattenNumbers(x);
    for (int i = 0; i < expected.size(); i++)
        if (inverseMasses[i] == 0)
            expected[i] = 0;
    assertClose(expected, flatten(forces), 1e-7);

    const Eigen::MatrixXd k = dense * inverseMasses.asDiagonal() * dense.transpose();
    ConstraintMatrix matrix(system);
    for (int repeat = 0; repeat < 2; repeat++) {
        matrix.factorize(jacobian);
        vector<double> solution = x;
        matrix.solve(solution);
        assertClose(flattenNumbers(x), k * flattenNumbers(solution), 1e-5);
        // The general part alone, as a step does it.
        vector<double> general = solution;
        std::copy(x.begin() + system.getFirstGeneral(), x.end(), general.begin() + system.getFirstGeneral());
        for (const ConstraintSystem::Part& part : system.getGeneralParts()) {
            ASSERT_EQUAL(ConstraintMatrix::REGULAR, matrix.tryToFactorize(jacobian, part));
            matrix.solve(general, part);
        }
        assertClose(flattenNumbers(solution), flattenNumbers(general), 1e-14);
    }
    vector<Vec3> ahead = e.positions;
    for (size_t i = 0; i < ahead.size(); i++)
        if (e.masses[i] > 0)
            ahead[i] += e.velocities[i] * 0.02;
    ConstraintSystem::Jacobian next(system.getNumEntries());
    system.evaluateJacobian(ahead, theta, next);
    NewtonMatrix newton(system);
    ASSERT(newton.factorize(next, jacobian));
    vector<double> solution = x;
    newton.solve(solution);
    const Eigen::MatrixXd a = denseJacobian(system, ahead) * inverseMasses.asDiagonal() * dense.transpose();
    assertClose(flattenNumbers(x), a * flattenNumbers(solution), 1e-5);

    // g''(v,v) and half its derivative, with parameters at rest and moving
    for (bool isMoving : {false, true}) {
        ExpressionParameters theta = system.getGivenParameters();
        theta.isMoving = isMoving;
        if (isMoving)
            for (double& rate : theta.rates)
                rate = uniform(-0.3, 0.3);
        const double h = 1e-5;
        ExpressionParameters thetaForward = theta, thetaBackward = theta;
        for (size_t i = 0; i < theta.values.size(); i++) {
            thetaForward.values[i] += theta.rates[i] * h;
            thetaBackward.values[i] -= theta.rates[i] * h;
        }
        vector<Vec3> forward = e.positions, backward = e.positions;
        for (size_t i = 0; i < forward.size(); i++) {
            forward[i] += moving[i] * h;
            backward[i] -= moving[i] * h;
        }
        ConstraintSystem::Jacobian forwardRows(system.getNumEntries()), backwardRows = forwardRows, rows = forwardRows;
        system.evaluateJacobian(forward, thetaForward, forwardRows);
        system.evaluateJacobian(backward, thetaBackward, backwardRows);
        system.evaluateVelocityJacobian(e.positions, moving, theta, rows);
        for (int entry = 0; entry < system.getNumEntries(); entry++)
            for (int j = 0; j < 3; j++) {
                const double difference = (forwardRows[entry][j] - backwardRows[entry][j]) / (2 * h);
                ASSERT(std::fabs(difference - rows[entry][j]) <= 1e-5 * (1 + std::fabs(difference)));
            }
        vector<double> curvature(m);
        system.evaluateCurvature(e.positions, moving, theta, curvature);
        if (!isMoving) {
            system.multiply(rows, moving, result);
            assertClose(flattenNumbers(curvature), flattenNumbers(result), 1e-12);
        }
        // dg/dt and its change in time
        vector<double> plus(m), minus(m);
        system.evaluate(forward, thetaForward, plus, forwardRows);
        system.evaluate(backward, thetaBackward, minus, backwardRows);
        system.multiply(jacobian, moving, result);
        system.addParameterMotion(e.positions, theta, result);
        assertClose((flattenNumbers(plus) - flattenNumbers(minus)) / (2 * h), flattenNumbers(result), 1e-6);
        system.multiply(forwardRows, moving, plus);
        system.addParameterMotion(forward, thetaForward, plus);
        system.multiply(backwardRows, moving, minus);
        system.addParameterMotion(backward, thetaBackward, minus);
        assertClose((flattenNumbers(plus) - flattenNumbers(minus)) / (2 * h), flattenNumbers(curvature), 1e-6);
    }
}

void testGivenOrder() {
    // Multipliers come back in the order of the constructor, distances first; those of expressions as they are.
    ConstraintSystem system({1, 2, 3, 4}, {{2, 3, 0.5}, {0, 1, 2.0}}, {{"x1-1", {2}, {}}, {"y1-1", {0}, {}}});
    const ExpressionParameters theta = system.getGivenParameters();
    vector<double> multipliers;
    for (int k = 0; k < system.getNumConstraints(); k++)
        multipliers.push_back(system.isExpression(k) ? 100.0 + system.describe(k)[22] - '0'
                                                     : system.getConstraint(k).particle1);
    vector<double> given;
    system.getGivenMultipliers(multipliers, given);
    ASSERT_EQUAL(4, (int) given.size());
    ASSERT_EQUAL(2 * 0.5 / 0.25, given[0]);
    ASSERT_EQUAL(0.0, given[1]);
    ASSERT_EQUAL(100.0, given[2]);
    ASSERT_EQUAL(101.0, given[3]);
}

// The error is a distance in units of 0.1 nm, however the constraint is written.
void testErrors() {
    for (const char* expression : {"z1", "1000*z1", "1e-7*z1", "(1+z1)^3-1"}) {
        ConstraintSystem system({2}, {}, {{expression, {0}, {}}});
        const ExpressionParameters theta = system.getGivenParameters();
        ConstraintSystem::Jacobian jacobian(system.getNumEntries());
        vector<double> g(1);
        system.evaluateJacobian({Vec3(3, 4, 0)}, theta, jacobian);
        ASSERT_EQUAL_TOL(1e-5, system.evaluate({Vec3(1, 2, 1e-6)}, theta, g, jacobian), 2e-6);
        ASSERT(system.evaluate({Vec3(1, 2, 0)}, theta, g, jacobian) == 0);
    }
}

static void assertFailure(const string& text, const vector<double>& masses, const vector<ExpressionConstraint>& given,
                          const vector<Vec3>& positions) {
    ConstraintSystem system(masses, {}, given);
    const ExpressionParameters theta = system.getGivenParameters();
    ConstraintMatrix matrix(system);
    ConstraintSystem::Jacobian jacobian(system.getNumEntries());
    system.evaluateJacobian(positions, theta, jacobian);
    assertThrows(text, [&] { matrix.factorize(jacobian); });
}

void testSingularRows() {
    const vector<Vec3> positions = {Vec3(0, 0, 0), Vec3(1, 0, 0), Vec3(2, 0, 0)};
    assertFailure("expression constraint 1 (x1^2 = 0) of particle 0 is zero", {1, 1, 1},
                  {{"x1-1", {1}, {}}, {"x1^2", {0}, {}}}, positions);
    assertFailure("the gradient of expression constraint 0 (sqrt(x1^2) = 0) of particle 0 is not finite", {1, 1, 1},
                  {{"sqrt(x1^2)", {0}, {}}}, positions);
    assertFailure("among the particles 0, 1 and 2 are redundant", {1, 1, 1},
                  {{"x1+x2-1", {0, 1}, {}}, {"x1+x2", {1, 2}, {}}, {"x1+2*x2+x3", {0, 1, 2}, {}}}, positions);
}

// The entries of L, which are the cost of a factorisation.
static size_t countFill(const ConstraintSystem& system) {
    vector<std::pair<int, int>> entries;
    for (const auto& coupling : system.getCouplings()) {
        const int row = system.getConstraintOf(coupling.row), column = system.getConstraintOf(coupling.column);
        if (row != column)
            entries.emplace_back(row, column);
    }
    return findEliminationTree(system.getNumConstraints(), entries).numEntries;
}

// A rod: sections of three particles, each rigid, joined by three expressions of both; the first is an anchor.
void testFillOfRod() {
    const string centre = "3*(x1+x2+x3-x4-x5-x6)";
    vector<double> fill;
    for (int sections : {50, 100, 200}) {
        vector<double> masses(3 * sections, 1.0);
        masses[0] = masses[1] = masses[2] = 0;
        vector<DistanceConstraint> distances;
        vector<ExpressionConstraint> expressions;
        for (int i = 0; i < sections; i++) {
            if (i == 0)
                continue;
            for (auto pair : {std::make_pair(0, 1), {0, 2}, {1, 2}})
                distances.push_back({3 * i + pair.first, 3 * i + pair.second, 1.0});
            for (int axis = 0; axis < 3; axis++) {
                string expression = centre + "-y1*z4";
                for (char& c : expression)
                    if (c == 'x')
                        c = "xyz"[axis];
                expressions.push_back({expression, {3 * i - 3, 3 * i - 2, 3 * i - 1, 3 * i, 3 * i + 1, 3 * i + 2}, {}});
            }
        }
        ConstraintSystem system(masses, distances, expressions);
        const ExpressionParameters theta = system.getGivenParameters();
        ASSERT_EQUAL(6 * (sections - 1), system.getNumConstraints());
        fill.push_back((double) countFill(system));
        // Blocks of six: 15 entries in each and at most 36 between neighbours.
        ASSERT(fill.back() <= 51.0 * sections);
    }
    ASSERT_EQUAL_TOL(2 * (fill[1] - fill[0]), fill[2] - fill[1], 0.01);
}

// Three expressions that join all molecules cost three entries for each of their constraints.
void testFillOfCentreOfMass() {
    const int waters = 60;
    vector<double> masses;
    vector<DistanceConstraint> distances;
    vector<int> oxygens;
    string sums[3];
    for (int i = 0; i < waters; i++) {
        masses.insert(masses.end(), {16, 1, 1});
        for (auto pair : {std::make_pair(0, 1), {0, 2}, {1, 2}})
            distances.push_back({3 * i + pair.first, 3 * i + pair.second, 0.1});
        oxygens.push_back(3 * i);
        for (int axis = 0; axis < 3; axis++)
            sums[axis] += string(i == 0 ? "" : "+") + AXES[axis] + std::to_string(i + 1);
    }
    vector<ExpressionConstraint> expressions;
    for (const string& sum : sums)
        expressions.push_back({sum, oxygens, {}});
    ConstraintSystem system(masses, distances, expressions);
    const ExpressionParameters theta = system.getGivenParameters();
    ASSERT_EQUAL(0, system.getFirstGeneral());
    ASSERT(countFill(system) <= (size_t) (waters * (3 + 9) + 3));
}

int main() {
    return runTests({
        {"random expressions against Lepton", testRandomExpressions},
        {"random expressions against differences", testRandomDifferences},
        {"expressions with kinks and jumps against Lepton", testPiecewiseExpressions},
        {"special expressions against Lepton", testSpecialExpressions},
        {"guarded branches", testGuards},
        {"many constraints of one expression", testGroups},
        {"mixed systems against dense algebra, small blocks", [] { testAgainstDense(6); }},
        {"mixed systems against dense algebra, a large block", [] { testAgainstDense(40); }},
        {"multipliers in the given order", testGivenOrder},
        {"errors are distances", testErrors},
        {"gradients that vanish or are not finite", testSingularRows},
        {"the fill of a rod", testFillOfRod},
        {"the fill of a fixed centre of mass", testFillOfCentreOfMass},
    });
}
