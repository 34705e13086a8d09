// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "step/StepDensity.h"
#include <algorithm>
#include <cmath>

using namespace OpenMMVRattle;

StepDensity::StepDensity() : StepDensity(SemiExplicit, 1.0, 0.0, 0.0) {
}

StepDensity::StepDensity(Update update, double nominal, double minimum, double maximum) : update(update) {
    smallest = maximum > 0 ? nominal / maximum : 0.0;
    lower = smallest;
    if (update == Bounded)
        lower = std::min(4 * smallest / 3, (1 + 2 * smallest) / 3);
    if (minimum > 0) {
        double upper = nominal / minimum;
        k = (1 - lower) / (upper - 1);
        upperSlope = upper * k;
    }
    else {
        k = 0;
        upperSlope = 1 - lower;
    }
}

double StepDensity::limit(double u) const {
    return (lower + upperSlope * u) / (1 + k * u);
}

double StepDensity::limitDerivative(double u) const {
    double denominator = 1 + k * u;
    return (upperSlope - lower * k) / (denominator * denominator);
}

double StepDensity::f(double rho, double a) {
    const double x = rho - a, one = 1 - a;
    return x - one * one / x;
}

// The positive root of x^2 - y x - (1-a)^2 = 0, without cancellation for y < 0.
double StepDensity::inverseOfF(double y, double a) {
    const double one = 1 - a;
    const double root = std::sqrt(y * y + 4 * one * one);
    return a + (y > 0 ? 0.5 * (y + root) : 2 * one * one / (root - y));
}

double StepDensity::boundedUpdate(double u, double previous) const {
    double margin = DOMAIN_MARGIN * (1 - smallest);
    return inverseOfF(
        2 * f(std::max(u, smallest + margin), smallest) - f(std::max(previous, smallest + margin), smallest), smallest);
}
