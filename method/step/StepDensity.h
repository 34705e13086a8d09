// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPDENSITY_H_
#define OPENMMVRATTLE_STEPDENSITY_H_

namespace OpenMMVRattle {

/**
 * The recursions of the step density rho, dt = stepSize/rho, and the bounds on the step. All recursions are symmetric
 * in rho[n-1/2] and rho[n+1/2], which is what makes the integration time-reversible.
 */
class StepDensity {
public:
    enum Update { SemiExplicit, Explicit, Bounded };
    /** A density of a sum update may lie outside the domain of f by its oscillation; this fraction of 1 - a keeps it in. */
    static constexpr double DOMAIN_MARGIN = 1e-3;
    StepDensity();
    /**
     * @param update     the recursion
     * @param nominal    the step size where u = 1 (ps)
     * @param minimum    the smallest step size that u can ask for (ps), smaller than nominal; 0 for no bound
     * @param maximum    the largest step size that u can ask for (ps), larger than nominal; 0 for no bound
     */
    StepDensity(Update update, double nominal, double minimum, double maximum);
    /**
     * B(u), the Moebius function through (0, lower), (1, 1) and (infinity, nominal/minimum) (docs/method.md, section 6,
     * after Leimkuhler and Reich, Simulating Hamiltonian Dynamics, section 9.3.3), where lower is nominal/maximum; for
     * the update Bounded it is a little larger, so that f(B(u)) stays finite.
     */
    double limit(double u) const;
    /** dB/du. */
    double limitDerivative(double u) const;
    /** rho[n+1/2] of the update Explicit (3.15): 2u - rho[n-1/2]; not necessarily positive. */
    static double sumUpdate(double u, double previous) {
        return 2 * u - previous;
    }
    /** f(rho) = (rho - a) - (1 - a)^2/(rho - a) maps (a, infinity) onto the reals, with f(1) = 0; and its inverse. */
    static double f(double rho, double a);
    static double inverseOfF(double y, double a);
    /** rho[n+1/2] of the update Bounded: f(rho[n+1/2]) + f(rho[n-1/2]) = 2 f(u); always larger than nominal/maximum. */
    double boundedUpdate(double u, double previous) const;
    /** Whether a density asks for a step of more than twice the maximum. */
    bool isFarBelowBound(double rho) const {
        return rho < 0.5 * smallest;
    }
    /** The numbers of f and B, for devices: a, and B(u) = (lower + upperSlope u)/(1 + curve u). */
    double getSmallest() const {
        return smallest;
    }
    double getLower() const {
        return lower;
    }
    double getUpperSlope() const {
        return upperSlope;
    }
    double getCurve() const {
        return k;
    }

private:
    Update update;
    double smallest; // a = nominal/maximum, 0 if there is no bound
    // B(u) = (lower + upperSlope u)/(1 + k u); with k = 0: lower + (1 - lower) u
    double lower, upperSlope, k;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPDENSITY_H_
