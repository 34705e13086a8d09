// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/ForceReach.h"
#include "openmm/AndersenThermostat.h"
#include "openmm/CMAPTorsionForce.h"
#include "openmm/CMMotionRemover.h"
#include "openmm/CustomAngleForce.h"
#include "openmm/CustomBondForce.h"
#include "openmm/CustomCentroidBondForce.h"
#include "openmm/CustomCompoundBondForce.h"
#include "openmm/CustomExternalForce.h"
#include "openmm/CustomGBForce.h"
#include "openmm/CustomHbondForce.h"
#include "openmm/CustomManyParticleForce.h"
#include "openmm/CustomNonbondedForce.h"
#include "openmm/CustomTorsionForce.h"
#include "openmm/GBSAOBCForce.h"
#include "openmm/GayBerneForce.h"
#include "openmm/HarmonicAngleForce.h"
#include "openmm/HarmonicBondForce.h"
#include "openmm/MonteCarloAnisotropicBarostat.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/MonteCarloFlexibleBarostat.h"
#include "openmm/MonteCarloMembraneBarostat.h"
#include "openmm/NonbondedForce.h"
#include "openmm/PeriodicTorsionForce.h"
#include "openmm/RBTorsionForce.h"
#include <set>
#include <typeindex>

using namespace OpenMMVRattle;

void ForceReach::add(const OpenMM::Force& force) {
    static const std::set<std::type_index> harmless = {
        typeid(OpenMM::CMAPTorsionForce),        typeid(OpenMM::CustomAngleForce),
        typeid(OpenMM::CustomBondForce),         typeid(OpenMM::CustomCentroidBondForce),
        typeid(OpenMM::CustomCompoundBondForce), typeid(OpenMM::CustomExternalForce),
        typeid(OpenMM::CustomGBForce),           typeid(OpenMM::CustomHbondForce),
        typeid(OpenMM::CustomManyParticleForce), typeid(OpenMM::CustomNonbondedForce),
        typeid(OpenMM::CustomTorsionForce),      typeid(OpenMM::GBSAOBCForce),
        typeid(OpenMM::GayBerneForce),           typeid(OpenMM::HarmonicAngleForce),
        typeid(OpenMM::HarmonicBondForce),       typeid(OpenMM::NonbondedForce),
        typeid(OpenMM::PeriodicTorsionForce),    typeid(OpenMM::RBTorsionForce)};
    static const std::set<std::type_index> barostats = {
        typeid(OpenMM::MonteCarloBarostat), typeid(OpenMM::MonteCarloAnisotropicBarostat),
        typeid(OpenMM::MonteCarloFlexibleBarostat), typeid(OpenMM::MonteCarloMembraneBarostat)};
    const std::type_index type = typeid(force);
    if (type == typeid(OpenMM::AndersenThermostat))
        hasThermostat = true;
    else if (type == typeid(OpenMM::CMMotionRemover))
        movesFrame = true;
    else if (barostats.count(type) > 0)
        hasBarostat = true;
    else if (harmless.count(type) == 0)
        isUnknown = true;
}
