// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPSOLVER_H_
#define OPENMMVRATTLE_STEPSOLVER_H_

#include "constraints/ConstraintSolver.h"
#include "constraints/ParameterMotion.h"
#include "openmm/Vec3.h"
#include "step/StepMonitor.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/**
 * The equations of a step from the state between two steps: (3.9)-(3.11) for a given density rho+ = rho[n+1/2], and these together
 * with the density equation rho+ + rho = u(q,p+) + u(q,p-) (3.14).
 */
class StepSolver {
public:
    enum Kind { Regular, First, Shortened };
    /** @param now    the state from which steps go; it is the one that the solver of the constraints has moved to */
    StepSolver(ConstraintSolver& constraints, const StepState& now);
    void setSettings(double stepSize, double newTolerance);

    /** A step is coming, which may move parameters of expressions. */
    void prepare();
    ParameterMotion motion;
    /** Find whether the velocities jump in it, after one of density rho, as they do where parameters begin to move, or stop. */
    void findJump(double rho);
    double
        jump; // the part of the kinetic energy that is in it; then next has the new velocities. Negative if there is none
    /** Solve (3.9)-(3.11) for a regular step, from p[n-1/2] and rho = rho[n-1/2]; returns whether that is done. */
    bool solve(double rho, double rhoNext);
    /** The same for a step of plain RATTLE from the on-step state, which is of another kind. */
    bool solveFromOnStep(Kind newKind, double stepSize);
    /** A step like that one backwards, from parameters that move at the same rates. */
    bool solveBackwards(double stepSize, StepState& back);
    /** What (3.14) needs that does not change in a step. */
    struct DensityEquation {
        double rho, known; // rho[n-1/2]; rho - u(q,p-)
        double explicitValue, offset; // the rho+ of (3.15), and what it lacked in the last step
        double rate; // of u along F - G^T Lambda
        double fallBack; // a rho+ to begin with where that of (3.15) is not positive
    };
    /** Solve (3.9)-(3.11) and (3.14) together, by chord iterations or, where these fail, a search for rhoNext; it is found too. */
    bool solve(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext);
    /** Say why the last of these failed. */
    std::string explainFailure();

    /** The step that was last tried: q[n+1], w[n+1/2], theta[n+1] and lambda[n] are found here, the rest of the state at its end later. */
    StepState next;
    Kind kind;
    double size; // ps
    /** It has become the last step. */
    void accept(StepState& last);

private:
    ConstraintSolver::Trial trialOf(Kind newKind, double kick, double drift);
    ConstraintSolver::Trial regularTrial(double rho, double rhoNext);
    ConstraintSolver::Guess regularGuess() const;
    bool solveByChord(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext);
    bool searchDensity(StepMonitor& monitor, const DensityEquation& equation, double& rhoNext);
    ConstraintSolver& constraints;
    const StepState& now;
    double h, tolerance, densityTolerance;
    std::vector<double> lastSolved; // lambda in the search for a density
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPSOLVER_H_
