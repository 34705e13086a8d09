// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_CONSTRAINEDINTEGRATOR_H_
#define OPENMMVRATTLE_CONSTRAINEDINTEGRATOR_H_

#include "openmm/Integrator.h"
#include "openmm/Kernel.h"
#include "openmm/internal/OSRngSeed.h"
#include <iosfwd>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <tuple>
#include <vector>

namespace OpenMMVRattle {

class IntegratorRun;
struct IntegratorSettings;
struct RunState;

/**
 * What the integrators of this plugin have in common, whatever steps they take: constraints given as expressions beside the System's,
 * their multipliers, counts of the work, and that all they need to go on is in checkpoints and States. Use
 * VariableStepRattleIntegrator or VariableStepRattleLangevinIntegrator.
 */
class ConstrainedIntegrator : public OpenMM::Integrator {
public:
    ~ConstrainedIntegrator() override;
    /**
     * Give the particles of the Context random velocities of a temperature that satisfy all constraints, those given as
     * expressions too: each is drawn from Maxwell's distribution, and all together are projected onto the constraints in the
     * metric of the masses, so that the mean kinetic energy is kT/2 for each degree of freedom that the constraints leave. It
     * does what setVelocitiesToTemperature() of the Context does, whose solver leaves expressions alone and can fail where
     * constraints are strongly coupled.
     *
     * Where the positions do not satisfy the constraints, the velocities satisfy them at the positions that the next step starts
     * from. The forces are computed once, for that step.
     *
     * @param temperature    the temperature, in K; not negative
     * @param randomSeed     the same seed gives the same velocities
     */
    void setVelocitiesToTemperature(double temperature, int randomSeed = osrngseed());
    /**
     * Get the Lagrange multipliers Lambda(q,p) (4.3) of the constraints at the current positions and velocities, in the order of
     * the System's constraints, and behind them those of addConstraint(). The force of constraint k of the System, g = |r|^2 -
     * d^2 with r = q_i - q_j, is -2 Lambda_k r on particle i and the opposite on j: a positive multiplier is a bond under
     * tension, whose tension is 2 Lambda_k d. The force of any constraint g = 0 on a particle is -Lambda_k dg/dq.
     * Before the first step this computes the forces.
     *
     * @return the multipliers in kJ/mol/nm^2, 0 for a constraint between two massless particles; and of addConstraint() in
     *         kJ/mol over the unit of the expression
     */
    std::vector<double> getMultipliers() const;
    /**
     * Get the Lagrange multiplier of one constraint of addConstraint(); see getMultipliers(). Where the expression is a reaction
     * coordinate minus its value, it is the force that holds the coordinate there, with the sign of a force against g.
     *
     * @param index    the index of the constraint, as addConstraint() has returned it
     * @return the multiplier in kJ/mol over the unit of the expression
     */
    double getExpressionConstraintMultiplier(int index) const;
    /**
     * Get how often the forces have been computed for this integrator since the Context was created or reinitialized.
     * This and the following counts are of the work done in this Context: they are not saved, and loading a checkpoint or a State
     * leaves them as they are.
     */
    long long getNumForceEvaluations() const;
    /** Get how many iterations the solver of the constraints has taken since then, those of trial steps among them. */
    long long getNumSolverIterations() const;
    /**
     * Tell whether the last step was taken by a GPU, on OpenCL, CUDA and HIP, and not on the host with forces from there, which is
     * slow for large systems. The first step of a run always is the host's. What else is left to the host is in docs/gpu.md.
     *
     * @return true if by a GPU; false on Reference and CPU, and before the first step
     */
    bool isOnDevice() const;
    /**
     * Set the relative tolerance of the constraints. Default: 1e-8.
     *
     * For a distance it is a fraction of that distance. For a constraint g = 0 of addConstraint() it is a fraction of 0.1 nm, about
     * the length of a bond, and the error that is compared with it is the distance of the particles from where g = 0 holds, to
     * first order: |g| over the Euclidean norm of the gradient of g with respect to the particles that have mass. It is
     * therefore the same for g and for 1000 g.
     *
     * @param tol    the tolerance; positive and finite
     */
    void setConstraintTolerance(double tol) override;
    /** Get the force groups that act, a bit for each: those that were set, without that of a monitor ForceGroupEnergy. */
    int getIntegrationForceGroups() const override;
    /**
     * Set which force groups to use for integration. Whether that of a monitor ForceGroupEnergy is among them is of no
     * meaning.
     *
     * @param groups    a set of bit flags
     */
    void setIntegrationForceGroups(int groups) override;
    /**
     * Add a constraint g = 0 to those of the System. g is an expression of the coordinates of some particles in nm, which are
     * called x1, y1, z1 for the first particle, x2, y2, z2 for the second, and so on; and of parameters of this constraint, which
     * have names. It has the syntax of OpenMM's custom forces: operators + - * / ^, their functions, and intermediate
     * values defined after a semicolon, as in "r - r0; r = sqrt((x1-x2)^2 + (y1-y2)^2 + (z1-z2)^2)". Derivatives are found
     * symbolically. Constraints that have the same expression, with different particles and values of parameters, are evaluated
     * together, which is much faster.
     *
     * The gradient of g must not vanish where g = 0: a point is kept on a sphere by r - r0 or by r^2 - r0^2, but not by
     * (r - r0)^2. Coordinates are taken as they are, not as their nearest periodic images. A particle of mass zero is a
     * fixed point; at least one of the particles must have mass, and none may be a virtual site.
     *
     * As with the System's constraints, positions that do not satisfy it are moved to the nearest ones that do, at the first
     * step. OpenMM itself knows nothing of it: Context::applyConstraints() and applyVelocityConstraints() leave it alone, and a
     * CompoundIntegrator's other integrators do not keep it. It works on every platform.
     *
     * A constraint that is added after the Context was created takes effect with Context::reinitialize(); until then steps throw an
     * exception.
     *
     * @param expression    the expression g
     * @param particles     the indices of the particles
     * @param parameters    the values of the parameters
     * @return the index of the constraint among those that were added
     */
    int addConstraint(const std::string& expression, const std::vector<int>& particles,
                      const std::map<std::string, double>& parameters = {});
    /** Get the number of constraints that addConstraint() has added. */
    int getNumExpressionConstraints() const;
    /**
     * Get what a constraint was added with.
     *
     * @param index              the index of the constraint
     * @param[out] expression    the expression
     * @param[out] particles     the indices of the particles
     * @param[out] parameters    the values of the parameters
     */
    void getExpressionConstraintParameters(int index, std::string& expression, std::vector<int>& particles,
                                           std::map<std::string, double>& parameters) const;
    /**
     * Change a constraint. New values of its parameters are met by the next step, which moves the particles there: its end satisfies the
     * constraint, with velocities v that belong to the motion, dg/dq v = -dg/dparameter (new - old)/(size of the step). It costs no
     * evaluation of the forces, and the step density goes on. The work that the motion does on the particles is the multiplier times
     * dg/dparameter times the change of the parameter; take the mean of the multipliers before and after the step. A change that no step
     * can make fails as a step, and the value stays as it was set. Before the first step after the user has set positions or
     * velocities, numbers that are asked for are those of particles put on the constraint, without a motion.
     *
     * Another expression, other particles or other names take effect with Context::reinitialize(), as for addConstraint().
     *
     * @param index         the index of the constraint
     * @param expression    the expression
     * @param particles     the indices of the particles
     * @param parameters    the values of the parameters
     */
    void setExpressionConstraintParameters(int index, const std::string& expression, const std::vector<int>& particles,
                                           const std::map<std::string, double>& parameters);
    /**
     * Change the value of one parameter of a constraint; see setExpressionConstraintParameters().
     *
     * @param index    the index of the constraint
     * @param name     the name of the parameter
     * @param value    its new value
     */
    void setExpressionParameterValue(int index, const std::string& name, double value);
    /**
     * Advance the simulation by a number of steps.
     *
     * @param steps    the number of steps to take
     */
    void step(int steps) override;

protected:
    explicit ConstrainedIntegrator(const IntegratorSettings& settings);
    void initialize(OpenMM::ContextImpl& context) override;
    void cleanup() override;
    std::vector<std::string> getKernelNames() override;
    void stateChanged(OpenMM::State::DataType changed) override;
    double computeKineticEnergy() override;
    bool kineticEnergyRequiresForce() const override;
    void createCheckpoint(std::ostream& stream) const override;
    void loadCheckpoint(std::istream& stream) override;
    void serializeParameters(OpenMM::SerializationNode& node) const override;
    void deserializeParameters(const OpenMM::SerializationNode& node) override;

    void settingsChanged();
    /** Take note of a step size that has been set and found to be right. */
    void takeStepSize(double size);
    void takeOver(const IntegratorSettings& newSettings);
    /** Throw an OpenMMException unless a value is positive and finite, or 0 if that stands for something. */
    void requirePositive(double value, const std::string& name) const;
    void requirePositiveOrZero(double value, const std::string& name, const std::string& zero) const;
    /** Throw one unless there is something with this index. */
    void requireIndex(int index, int count, const std::string& what) const;
    IntegratorRun& requireRun() const;
    /** The same for one that is about to move the particles. */
    IntegratorRun& requireRunForStep();
    std::unique_ptr<IntegratorSettings> settings;
    std::unique_ptr<IntegratorRun> run; // in the Context, as long as there is one

private:
    /** The runs of the other integrators of this package in the same CompoundIntegrator. */
    std::vector<IntegratorRun*> getOtherRuns() const;
    ConstrainedIntegrator(const ConstrainedIntegrator&) = delete;
    ConstrainedIntegrator& operator=(const ConstrainedIntegrator&) = delete;
    std::string getName() const;
    void requireFiniteParameter(const std::string& expression, const std::string& name, double value) const;
    void checkConstraint(const std::string& expression, const std::vector<int>& particles,
                         const std::map<std::string, double>& parameters);
    void checkExpressionConstraintIndex(int index) const;
    void resume(const IntegratorSettings& saved, RunState& state);
    OpenMM::Kernel kernel;
    mutable unsigned long long lastSaved; // fingerprint of the Context in the last checkpoint
    // What has been found to be right: expression, number of particles and names of the parameters.
    std::set<std::tuple<std::string, size_t, std::vector<std::string>>> checkedExpressions;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_CONSTRAINEDINTEGRATOR_H_
