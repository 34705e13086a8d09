// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPSTATE_H_
#define OPENMMVRATTLE_STEPSTATE_H_

#include "constraints/ConstraintSolver.h"
#include "openmm/Vec3.h"
#include "step/AutomaticControl.h"
#include "step/StepDensity.h"
#include "step/StepMonitor.h"
#include <vector>

namespace OpenMMVRattle {

/** An on-step state, and the half step that has led to it. */
struct StepState {
    std::vector<OpenMM::Vec3> q, v, w, force;  // q[n], M^-1 p[n], M^-1 p[n-1/2] and F(q[n])
    ExpressionParameters theta;                // theta[n], with the rates of the step that has led to q[n]
    std::vector<double> lambda, rightSide;     // Lambda(q[n],p[n]) and K Lambda
    double groupEnergy = 0;                    // of the monitor's force group at q[n]
};

/** What a user can choose. */
struct StepSettings {
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

/** What the paper's control keeps between two steps beside the density. */
struct MonitorMemory {
    bool hasHalfStepValue = false;
    double u = 1, halfStepValue = 0; // u(q[n],p[n]), u(q[n],p[n-1/2])
    double rate = 0; // the change of u along F - G^T Lambda; only the speed of convergence depends on it
    double densityOffset = 0; // what (3.14) and (3.15) differed by in the last step
};

/** What the next step depends on beside the settings, positions, velocities and forces; saved for a restart. */
struct StepMemory : MonitorMemory {
    bool hasDensity;
    double density; // rho[n-1/2]
    std::vector<OpenMM::Vec3> halfStepVelocities; // M^-1 p[n-1/2]
    std::vector<double> parameters,
        parameterRates; // theta[n] of the expressions, and dtheta/dt of the step to q[n]
    std::vector<double> multiplierOffset; // lambda[n-1] - Lambda[n-1], in internal order
    std::vector<double> references; // U_k,ref in force
    // What could be computed again but for the last bits, which decide whether a restart is exact:
    std::vector<double> multipliers, monitorValues; // Lambda and U_k at (q[n],p[n])
    AutomaticControl::Memory automatic; // of automatic step control
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPSTATE_H_
