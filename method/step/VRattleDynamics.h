// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_VRATTLEDYNAMICS_H_
#define OPENMMVRATTLE_VRATTLEDYNAMICS_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/AutomaticControl.h"
#include "step/Dynamics.h"
#include "step/StepDensity.h"
#include "step/StepMonitor.h"
#include <functional>
#include <limits>
#include <vector>

namespace OpenMMVRattle {

/**
 * The method VRATTLE, equations (3.9)-(3.14) of Barth, Leimkuhler and Reich, for a system of particles whose forces
 * somebody else computes. It knows no Context, no Kernel and no Platform.
 *
 * A step is made in two halves, around the one evaluation of the forces that it costs:
 *
 *     dynamics.step(maxStep);                  // (3.9)-(3.11), (3.14): new positions, getNextPositions()
 *     ... compute the forces there ...
 *     dynamics.finish(forces, groupEnergy);    // (3.12)-(3.13): new on-step velocities; the step is complete
 *
 * Until finish() has returned, the state before the step is untouched. Momenta are kept as velocities: v stands for
 * M^-1 p[n], w for M^-1 p[n-1/2].
 */
class VRattleDynamics : public Dynamics {
public:
    /** What a user can choose. */
    struct Settings {
        double stepSize;                      // the nominal step h (ps)
        double minimumStep, maximumStep;      // bounds (ps), 0 for none
        double tolerance;                     // of the constraints, relative
        StepDensity::Update update;
        std::vector<StepMonitor::Term> terms; // a reference of 0 is taken at the first step
        bool isFixedStep; // rho = 1 whatever the monitors say (a calibration run)
        // Automatic step control, in place of monitors, update and maximum. A reference of 0 stands for the one in force.
        bool isAutomatic = false;
        double automaticReferences[AutomaticControl::NUM_MONITORS] = {};
        int automaticRequest = 0; // changes when references in force are to be forgotten
        int calibrationSteps = 1; // how many steps the references are found from
    };

    /** What the next step depends on beside the settings, positions, velocities and forces; saved for a restart. */
    struct Memory {
        bool hasDensity;
        double density; // rho[n-1/2]
        std::vector<OpenMM::Vec3> halfStepVelocities; // M^-1 p[n-1/2]
        std::vector<double> parameters,
            parameterRates; // theta[n] of the expressions, and dtheta/dt of the step to q[n]
        std::vector<double> multiplierOffset; // lambda[n-1] - Lambda[n-1], in internal order
        std::vector<double> references; // U_k,ref in force
        // What could be computed again but for the last bits, which decide whether a restart is exact:
        std::vector<double> multipliers, monitorValues; // Lambda and U_k at (q[n],p[n])
        bool hasHalfStepValue;
        double u, halfStepValue; // u(q[n],p[n]), u(q[n],p[n-1/2])
        double rate; // the change of u along F - G^T Lambda
        double densityOffset; // what (3.14) and (3.15) differed by in the last step
        AutomaticControl::Memory automatic; // of automatic step control
    };

    VRattleDynamics(const std::vector<double>& masses, const std::vector<DistanceConstraint>& constraints,
                    const std::vector<ExpressionConstraint>& expressions = {});

    void setParallel(const Parallel& parallel, int numThreads) override;

    /**
     * Take over settings. In the course of a run the density goes on where they allow it: it is scaled with u, and the
     * half-step momentum is formed anew.
     *
     * @throws StepFailure    if a monitor needs constraints and there are none
     */
    void setSettings(const Settings& settings);

    bool projectPositions(std::vector<OpenMM::Vec3>& positions) override;
    void begin(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy) override;
    /** All that a trial run or a start changes, to be put back. */
    struct Kept {
        Settings settings;
        std::vector<OpenMM::Vec3> positions, velocities, forces;
        double groupEnergy;
        std::vector<double> target;
        Memory memory;
        std::vector<double> rightSide;
    };
    Kept keep() const;
    /** Put back what was kept, to the last bit. */
    void putBack(const Kept& kept);
    std::function<void()> remember() override {
        return [this, kept = keep()] { putBack(kept); };
    }
    Memory getMemory() const;
    /**
     * Change the parameters of an expression: the next step leads to positions that satisfy the constraint with these, in that
     * its position equation is g(q[n+1]; theta[n+1]) = 0 (3.11), and the velocities at its end
     * G v + (dg/dtheta) (theta[n+1] - theta[n])/dt = 0 (3.13).
     */
    void setParameters(int expression, const std::map<std::string, double>& parameters) override {
        getConstraintSystem().writeParameters(expression, parameters, target);
    }
    const ExpressionParameters& getParameters() const override {
        return theta;
    }
    void adoptParameters() override;
    /**
     * Go on from a saved state as if nothing had happened. The positions and velocities are taken as they are, so that the
     * following steps are the same to the last bit if the forces are.
     */
    void resume(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                const std::vector<OpenMM::Vec3>& forces, double groupEnergy, const Memory& memory);
    /**
     * Go on from an on-step state that somebody else's steps have led to, in the middle of a sequence of densities with the same
     * settings and references. The velocities are taken as they are; the half-step momentum is formed from them.
     *
     * @param density          rho[n-1/2]
     * @param halfStepValue    u(q[n],p[n-1/2]), or null if it is not known
     * @param offset           what (3.14) and (3.15) differed by in the last step
     * @throws StepFailure     if the multipliers or monitors are not defined there; then everything is as it was
     */
    void adopt(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
               const std::vector<OpenMM::Vec3>& forces, double groupEnergy, double density, const double* halfStepValue,
               double offset);
    /** u(q[n],p[n-1/2]), which (3.14) takes, for somebody who goes on elsewhere; it is evaluated if need be. */
    double findHalfStepValue();
    void setReferences(const std::vector<double>& references) override;
    /** Go on from a changed state, with the density scaled with u, so that it stays free of oscillation. */
    void changeState(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                     const std::vector<OpenMM::Vec3>& forces, double groupEnergy) override;
    bool changeFrame(const std::vector<OpenMM::Vec3>& velocities) override;
    /** Go on with changed velocities at the same positions; as changeState(). */
    void changeVelocities(const std::vector<OpenMM::Vec3>& velocities) override;
    /**
     * Go on with other forces at the same positions and velocities, since a parameter of a force has changed; as changeState().
     *
     * @param[in,out] forces    the applied forces; their storage is taken over, and that of the forces before left in its place
     * @throws StepFailure    if they are not finite; then nothing has been changed
     */
    void changeForces(std::vector<OpenMM::Vec3>& forces, double groupEnergy) override;

    /**
     * The first half of a step.
     *
     * @param maxStep    the step must not be longer than this (ps); a shortened step goes on with the same density
     * @return the size of the step (ps)
     * @throws StepFailure    if the equations of the step have no solution that the iteration finds
     */
    double step(double maxStep) override;
    /**
     * The second half of a step.
     *
     * @param[in,out] forces    the applied forces at getNextPositions(); if the step is complete their storage is taken
     *                          over, and that of the forces before is left in its place
     * @param groupEnergy       the energy of the monitor's force group there
     * @return whether the step is complete. If not, the state is as before step(), the density of the first step is now known
     *         better, and both halves are to be done again. This happens once, at a start with given reference values.
     * @throws StepFailure    if the forces are not finite or the constraints have become dependent
     */
    bool finish(std::vector<OpenMM::Vec3>& forces, double groupEnergy) override;
    /**
     * The step in progress has failed, in either half or in between: nothing that was computed for it, as the density and the
     * reference values of a first step, is of any use to the next.
     */
    void abandonStep() override;
    /** Whether the next step continues a sequence of densities; if not, it is the first one. */
    bool hasStarted() const {
        return hasDensity;
    }
    /** The state and the references of automatic step control. */
    const AutomaticControl& getAutomaticControl() const {
        return automatic;
    }
    void reverse() override;

    const ConstraintSystem& getConstraintSystem() const override {
        return solver.getSystem();
    }
    const std::vector<OpenMM::Vec3>& getPositions() const override {
        return q;
    }
    /** q[n+1], after step(). */
    const std::vector<OpenMM::Vec3>& getNextPositions() const override {
        return qNext;
    }
    const std::vector<OpenMM::Vec3>& getVelocities() const override {
        return v;
    }
    const std::vector<OpenMM::Vec3>& getForces() const override {
        return force;
    }
    double getGroupEnergy() const override {
        return groupEnergy;
    }
    /** rho[n-1/2]. */
    double getDensity() const override {
        return rho;
    }
    const std::vector<double>& getMonitorValues() const override {
        return values;
    }
    /** U_k,ref, 0 while it is not known; under automatic step control those of its two monitors. */
    std::vector<double> getReferences() const override;
    const std::vector<double>& getMultipliers() const override {
        return lambda;
    }
    long long getNumIterations() const override {
        return solver.getNumIterations() + numNewtonIterations;
    }
    long long getNumRescues() const {
        return numRescues;
    }

private:
    enum StepKind { Regular, First, Shortened };
    void requireConstraintsFor(const std::vector<StepMonitor::Term>& terms) const;
    bool takeAutomaticReferences(const Settings& newSettings);
    void setControlSettings();
    void startAutomatic();
    void acceptAutomatic();
    void setMemory(const Memory& memory);
    void forgetDensity();
    void rescaleDensity(double oldU);
    double combineAndLimit(const std::vector<double>& monitorValues) const;
    bool needsHalfStepValue() const;
    void beginAt(const std::vector<OpenMM::Vec3>& positions, const std::vector<OpenMM::Vec3>& velocities,
                 const std::vector<OpenMM::Vec3>& forces, double energy, const Kept& before);
    void takeTrialValues();

    void prepareParameters();
    void setRates(ExpressionParameters& parameters, double size) const;
    void findJump();

    void ensureMonitor();
    void formHalfStepVelocities();
    double evaluateU(const std::vector<OpenMM::Vec3>& velocities, const ExpressionParameters& parameters);
    void evaluateOnStep(const ConstraintSolver::OnStep& state, double energy, std::vector<double>& monitorValues);
    double evaluateRate();
    ConstraintSolver::Trial trialTo(double kick, double drift, const std::vector<OpenMM::Vec3>& start);
    bool solvePositions(const ConstraintSolver::Trial& trial, bool isFromOnStep);
    bool solveCoupled();
    bool solveCoupledByNewton();
    double solveRegular();
    void keepOffsets();
    [[noreturn]] void throwNotConverged(const ConstraintSolver::Trial& trial);

    double findFirstDensity();
    bool evaluateBackwards(const std::vector<OpenMM::Vec3>& forces, double energy, std::vector<double>& backValues);
    std::vector<double> evaluateHalfSteps();
    bool startDensityFrom(const std::vector<double>& startValues, const std::vector<double>& backValues, bool hasBack);
    void scaleReferences(const std::vector<double>& startValues, const std::vector<double>& backValues);
    static double startValue(double start, double ahead, const double* back);

    ConstraintSolver solver;
    const ConstraintSystem& system;
    const std::vector<int>& movingParticles;
    StepMonitor monitor;
    StepDensity density;
    AutomaticControl automatic;
    Settings settings;

    // The state between two steps.
    std::vector<OpenMM::Vec3> q, v, w, force;
    ExpressionParameters theta; // theta[n], with the rates of the step that has led to q[n]
    std::vector<double> target; // theta[n+1], what the next step leads to
    double groupEnergy, rho, u;
    std::vector<double> lambda, rightSide, values; // Lambda, K Lambda and U_k
    std::vector<double> multiplierOffset; // lambda[n-1] - Lambda[n-1]
    bool hasDensity, hasHalfStepValue;
    double halfStepValue, rate; // u(q[n],p[n-1/2]); the change of u along F - G^T Lambda
    double densityOffset; // what (3.14) and (3.15) differed by in the last step
    double firstDensity; // of the first step, once it is known; else 0
    bool isStartedNow; // automatic step control, by the step in progress
    AutomaticControl::Memory controlBefore; // that
    bool isCalm; // whether the first step is one that starts no sequence
    std::vector<char> isNegligible; // each monitor, at the first step
    std::vector<double> referencesBefore; // the first step, as long as firstDensity is known

    bool isMonitorCurrent; // whether the monitor has the forces at q[n]

    // The step in progress.
    StepKind stepKind;
    std::vector<OpenMM::Vec3> qNext, wNext, vNext, acceleration, gradient, halfStepChange;
    double rhoNext, stepNext, kickNext;
    std::vector<double> parameterChange; // theta[n+1] - theta[n]
    bool areParametersChanging;
    // theta[n+1], and theta[n] with the rates of this step, at which (3.14) takes u(q[n],p[n+1/2])
    ExpressionParameters thetaNext, thetaHalf;
    double densityScale; // by which u and rho change where the parameters begin to move, or stop
    bool isJump; // whether that changes the velocities much
    std::vector<double> lambdaNext, lambdaOnStep, rightSideNext, valuesNext;
    ConstraintSolver::HalfStep atHalfStep;
    std::vector<double> valuesHalf;
    std::vector<double> multiplierTrial, rightSideTrial, valuesTrial, correction, coupling, response;

    // Work space of the start.
    std::vector<OpenMM::Vec3> qBack, wBack, vBack, forceBack;
    ExpressionParameters thetaBack;
    std::vector<double> lambdaBack, rightSideBack;

    bool isRescued; // by the step in progress
    long long numNewtonIterations, numRescues; // those of (3.14)
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_VRATTLEDYNAMICS_H_
