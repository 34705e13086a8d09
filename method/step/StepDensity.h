// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPDENSITY_H_
#define OPENMMVRATTLE_STEPDENSITY_H_

#include <algorithm>
#include <cmath>

namespace OpenMMVRattle {

/**
 * The recursions of the step density rho, dt = stepSize/rho, and the bounds on the step. All recursions are symmetric
 * in rho[n-1/2] and rho[n+1/2], which is what makes the integration time-reversible.
 */
struct StepDensity {
    enum Update { SemiExplicit, Explicit, Bounded };
    /** A density of a sum update may lie outside the domain of f by its oscillation; this fraction of 1 - a keeps it in. */
    static constexpr double DOMAIN_MARGIN = 1e-3;

    double smallest = 0; // a = nominal/maximum, 0 if there is no bound
    // B(u) = (lower + upperSlope u)/(1 + curve u)
    double lower = 0, upperSlope = 1, curve = 0;

    StepDensity() = default;
    /**
     * @param update     the recursion
     * @param nominal    the step size where u = 1 (ps)
     * @param minimum    the smallest step size that u can ask for (ps), smaller than nominal; 0 for no bound
     * @param maximum    the largest step size that u can ask for (ps), larger than nominal; 0 for no bound
     */
    StepDensity(Update update, double nominal, double minimum, double maximum) {
        smallest = maximum > 0 ? nominal / maximum : 0.0;
        lower = update == Bounded ? std::min(4 * smallest / 3, (1 + 2 * smallest) / 3) : smallest;
        const double upper = minimum > 0 ? nominal / minimum : 0.0;
        curve = minimum > 0 ? (1 - lower) / (upper - 1) : 0.0;
        upperSlope = minimum > 0 ? upper * curve : 1 - lower;
    }
    /**
     * B(u), the Moebius function through (0, lower), (1, 1) and (infinity, nominal/minimum) (docs/method.md, section 6,
     * after Leimkuhler and Reich, Simulating Hamiltonian Dynamics, section 9.3.3), where lower is nominal/maximum; for
     * the update Bounded it is a little larger, so that f(B(u)) stays finite.
     */
    double limit(double u) const {
        return (lower + upperSlope * u) / (1 + curve * u);
    }

    /** rho[n+1/2] of the update Explicit (3.15): 2u - rho[n-1/2]; not necessarily positive. */
    static double sumUpdate(double u, double previous) {
        return 2 * u - previous;
    }
    /** f(rho) = (rho - a) - (1 - a)^2/(rho - a) maps (a, infinity) onto the reals, with f(1) = 0. */
    static double f(double rho, double a) {
        const double x = rho - a, one = 1 - a;
        return x - one * one / x;
    }
    /** Its inverse: the positive root of x^2 - y x - (1-a)^2 = 0, without cancellation for y < 0. */
    static double inverseOfF(double y, double a) {
        const double one = 1 - a, root = std::sqrt(y * y + 4 * one * one);
        return a + (y > 0 ? 0.5 * (y + root) : 2 * one * one / (root - y));
    }
    /** rho[n+1/2] of the update Bounded: f(rho[n+1/2]) + f(rho[n-1/2]) = 2 f(u); always larger than nominal/maximum. */
    double boundedUpdate(double u, double previous) const {
        const double least = smallest + DOMAIN_MARGIN * (1 - smallest);
        return inverseOfF(2 * f(std::max(u, least), smallest) - f(std::max(previous, least), smallest), smallest);
    }
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPDENSITY_H_
