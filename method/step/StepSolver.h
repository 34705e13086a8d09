// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPSOLVER_H_
#define OPENMMVRATTLE_STEPSOLVER_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/StepState.h"
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** The density equation rho+ + rho = u(q,p+) + u(q,p-) (3.14), as its solver needs it. */
class DensityEquation {
public:
    /** What does not change in a step. */
    struct Given {
        double rho, known;            // rho[n-1/2]; rho - u(q,p-)
        double explicitValue, offset; // the rho+ of (3.15), and what it lacked in the last step
        double rate;                  // of u along F - G^T Lambda
        double fallBack;              // a rho+ to begin with where that of (3.15) is not positive
    };
    virtual ~DensityEquation() {
    }
    /** What is to see Lambda(q,p+) and K times it when they are known. */
    virtual ConstraintSolver::Observer* observeTrial(const std::vector<double>& multipliers,
                                                     const std::vector<double>& rightSide) = 0;
    /** u(q,p+) at velocities w+, with Lambda(q,p+) that has been seen. */
    virtual double evaluate(const std::vector<OpenMM::Vec3>& w, const std::vector<double>& multipliers) = 0;
    /** du/dw there. */
    virtual void findGradient(const std::vector<OpenMM::Vec3>& w, const ExpressionParameters& theta,
                              const std::vector<double>& multipliers, std::vector<OpenMM::Vec3>& gradient) = 0;
};

/**
 * The equations of a step from the state between two steps: (3.9)-(3.11) for a given density rho+ = rho[n+1/2], and these together
 * with (3.14).
 */
class StepSolver {
public:
    /** @param now    the state from which steps go; it is the one that the solver of the constraints has moved to */
    StepSolver(ConstraintSolver& constraints, const StepState& now);
    void setSettings(double stepSize, double tolerance);

    /** A step is coming, at the end of which the parameters of expressions are these. */
    void prepare(const std::vector<double>& target);
    bool areParametersChanging() const {
        return isMoving;
    }
    /** theta[n+1] - theta[n] */
    const std::vector<double>& getParameterChange() const {
        return parameterChange;
    }
    /** The rates of parameters that move in a step of that size. */
    void setRates(ExpressionParameters& theta, double size) const;
    /** theta[n] with the rates of a step of that size. */
    const ExpressionParameters& parametersAtRateOf(double size);

    /** Solve (3.9)-(3.11) for a regular step, from p[n-1/2] and rho = rho[n-1/2]; returns whether that is done. */
    bool solve(double rho, double rhoNext);
    /** The same for a step of plain RATTLE from the on-step state. */
    bool solveFromOnStep(double size);
    /** The same backwards, from parameters that move at the same rates. */
    bool solveBackwards(double size, StepState& back);
    /** Solve (3.9)-(3.11) and (3.14) together, by chord iterations and where these fail by Newton's; rhoNext is found too. */
    bool solve(DensityEquation& equation, const DensityEquation::Given& given, double& rhoNext);
    /** Say why the last of these failed. */
    std::string explainFailure();

    /** Instead of all these: the step is one that has led to where it comes from. */
    void stay();

    /** lambda[n] - Lambda[n], the error of the starting value of the iteration, is added to the next one. */
    void keepOffset();
    std::vector<double> multiplierOffset;
    /** The same in two parts: an observer of the end of the step, which passes on what it sees, and when that has been accepted. */
    ConstraintSolver::Observer* observeOffset(ConstraintSolver::Observer* observer);
    void acceptOffset() {
        multiplierOffset.swap(offsetNext);
    }
    /** What is found: q[n+1], w[n+1/2] and theta[n+1]; the rest of this state is of the end of the step, which is not known here. */
    StepState next;
    long long getNumIterations() const {
        return constraints.getNumIterations() + numNewtonIterations;
    }

private:
    struct OffsetObserver : ConstraintSolver::Observer {
        explicit OffsetObserver(StepSolver& solver) : solver(solver) {
        }
        void seeParticles(int block) override;
        void seeConstraints(int range, int first, int end) override;
        StepSolver& solver;
        ConstraintSolver::Observer* other = nullptr;
    };
    ConstraintSolver::Trial trialTo(double kick, double drift, const std::vector<OpenMM::Vec3>& start);
    ConstraintSolver::Guess regularGuess() const;
    bool solveByChord(DensityEquation& equation, const DensityEquation::Given& given, double& rhoNext);
    bool solveByNewton(DensityEquation& equation, const DensityEquation::Given& given, double& rhoNext);
    ConstraintSolver& constraints;
    const StepState& now;
    double h, tolerance;
    bool isMoving, isFromOnStep;
    double lastDrift; // of the last trial
    ExpressionParameters thetaHalf; // theta[n] with the rates of this step, at which (3.14) takes u(q[n],p[n+1/2])
    std::vector<double> parameterChange, lambdaNext, offsetNext;
    OffsetObserver offsetObserver;
    std::vector<double> multiplierTrial, rightSideTrial, correction, coupling, response;
    std::vector<OpenMM::Vec3> gradient, halfStepChange;
    long long numNewtonIterations; // those of (3.14)
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPSOLVER_H_
