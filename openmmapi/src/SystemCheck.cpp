// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "SystemCheck.h"
#include "openmm/MonteCarloAnisotropicBarostat.h"
#include "openmm/MonteCarloBarostat.h"
#include "openmm/MonteCarloFlexibleBarostat.h"
#include "openmm/MonteCarloMembraneBarostat.h"
#include "openmm/Platform.h"
#include "openmm/System.h"
#include "openmm/internal/AndersenThermostatImpl.h"
#include "openmm/internal/ForceImpl.h"
#include "openmm/kernels.h"
#include <algorithm>
#include <cmath>
#include <numeric>
#include <string>
#include <vector>

using namespace OpenMMVRattle;
using OpenMM::ContextImpl;
using OpenMM::ForceImpl;
using OpenMM::System;
using std::string;
using std::vector;

namespace {

void requireMasses(const System& system, const IntegratorSettings& settings) {
    for (int i = 0; i < system.getNumParticles(); i++) {
        const double mass = system.getParticleMass(i);
        settings.require(mass >= 0 && std::isfinite(mass), "the mass of particle ", i, " is ", mass,
                         " amu, and masses are positive, or 0 for a particle that does not move; correct it with "
                         "setParticleMass() of the System");
    }
}

// To begin a message with.
string nameOf(const IntegratorSettings& settings, size_t index) {
    return "expression constraint " + std::to_string(index) + " (" + settings.expressions[index].expression + ") ";
}

void requireExpressions(const System& system, const IntegratorSettings& settings) {
    for (size_t e = 0; e < settings.expressions.size(); e++) {
        const string constraint = nameOf(settings, e);
        bool canMove = false;
        for (int particle : settings.expressions[e].particles) {
            settings.require(particle < system.getNumParticles(), constraint, "is of particle ", particle,
                             ", and the System has ", system.getNumParticles());
            settings.require(!system.isVirtualSite(particle), constraint, "is of particle ", particle,
                             ", which is a virtual site; write it with the particles that define the site");
            canMove |= system.getParticleMass(particle) > 0;
        }
        settings.require(canMove, constraint, "has no particle with mass, and so nothing that it could move");
    }
}

// (OpenMM refuses a constraint between a particle with mass and one without; two that do not move may be what is left of a
// frozen molecule.) A virtual site is where its particles put it, so that a constraint on it would be passed over.
void requireConstraints(const System& system, const IntegratorSettings& settings) {
    for (int i = 0; i < system.getNumConstraints(); i++) {
        int particle1, particle2;
        double length;
        system.getConstraintParameters(i, particle1, particle2, length);
        const auto require = [&](bool holds, const auto&... parts) {
            settings.require(holds, "constraint ", i, " of the System, of the particles ", particle1, " and ",
                             particle2, ", ", parts...);
        };
        require(length > 0 && std::isfinite(length), "has a length of ", length,
                " nm, which is not a positive finite number; correct it with setConstraintParameters() of the System");
        for (int particle : {particle1, particle2})
            require(!system.isVirtualSite(particle), "is of the virtual site ", particle,
                    ", which is where the particles that define it put it and cannot be held; constrain those");
    }
}

bool usesKernel(const ForceImpl& force, const string& name) {
    const vector<string> names = const_cast<ForceImpl&>(force).getKernelNames();
    return std::find(names.begin(), names.end(), name) != names.end();
}

// A Drude particle moved like any other would take up heat from the rest. The class DrudeForce is in a library of its
// own, which we do not link with, so it is recognised by its kernel.
void refuseDrudeParticles(const ForceImpl& force, const IntegratorSettings& settings) {
    settings.require(
        !usesKernel(force, "CalcDrudeForce"),
        "the System has a DrudeForce and Drude particles need an integrator made for them; use "
        "DrudeSCFIntegrator, DrudeNoseHooverIntegrator or DrudeLangevinIntegrator, or a force field without "
        "Drude particles");
}

// For each particle the number of its group.
vector<int> numberGroups(const vector<vector<int>>& groups, int numParticles) {
    vector<int> result(numParticles);
    for (size_t group = 0; group < groups.size(); group++)
        for (int particle : groups[group])
            result[particle] = (int) group;
    return result;
}

template <class Barostat> bool scalesEachParticle(const OpenMM::Force& force) {
    const Barostat* barostat = dynamic_cast<const Barostat*>(&force);
    return barostat != nullptr && !barostat->getScaleMoleculesAsRigid();
}

// How a Force that changes velocities or positions groups the particles: what it leaves together, and why not the rest.
struct Grouping {
    vector<int> groupOf;
    string reason, consequence, wayOut;
};

/*
 * OpenMM's thermostat draws the velocities of all particles at once that the System's constraints join, and its barostats
 * move molecules, which are what the System's constraints, bonds and virtual sites join, or each particle by itself. Of
 * expressions they know nothing: what these join beyond that is moved about in parts, and comes out at another
 * temperature or volume than asked for.
 */
bool findGrouping(const ContextImpl& context, const ForceImpl& impl, Grouping& grouping) {
    const System& system = context.getSystem();
    const OpenMM::Force& force = impl.getOwner();
    const int numParticles = system.getNumParticles();
    grouping.wayOut = "hold a distance by a constraint of the System";
    if (usesKernel(impl, OpenMM::ApplyAndersenThermostatKernel::Name())) {
        grouping.groupOf = numberGroups(OpenMM::AndersenThermostatImpl::calcParticleGroups(system), numParticles);
        grouping.reason = "no constraint of the System joins them";
        grouping.consequence = "the temperature";
        return true;
    }
    if (!usesKernel(impl, OpenMM::ApplyMonteCarloBarostatKernel::Name()))
        return false;
    grouping.consequence = "the volume";
    if (scalesEachParticle<OpenMM::MonteCarloBarostat>(force) ||
        scalesEachParticle<OpenMM::MonteCarloAnisotropicBarostat>(force) ||
        scalesEachParticle<OpenMM::MonteCarloMembraneBarostat>(force) ||
        scalesEachParticle<OpenMM::MonteCarloFlexibleBarostat>(force)) {
        grouping.groupOf.resize(numParticles);
        std::iota(grouping.groupOf.begin(), grouping.groupOf.end(), 0);
        grouping.reason = "it is set to move each particle by itself";
        grouping.wayOut = "call setScaleMoleculesAsRigid(True) of the barostat";
        return true;
    }
    grouping.groupOf = numberGroups(context.getMolecules(), numParticles);
    grouping.reason = "they are of different molecules";
    grouping.wayOut +=
        ", or join the particles by a bond of a Force (of no strength, say), which makes them a molecule";
    return true;
}

void requireKnownGroups(const ContextImpl& context, const ForceImpl& impl, const IntegratorSettings& settings) {
    Grouping grouping;
    if (!findGrouping(context, impl, grouping))
        return;
    for (size_t e = 0; e < settings.expressions.size(); e++) {
        int first = -1;
        for (int particle : settings.expressions[e].particles) {
            if (context.getSystem().getParticleMass(particle) == 0)
                continue; // a fixed point takes up no heat
            if (first < 0)
                first = particle;
            if (grouping.groupOf[particle] == grouping.groupOf[first])
                continue;
            const string name = impl.getOwner().getName();
            settings.refuse(nameOf(settings, e), "joins the particles ", first, " and ", particle, ", which ", name,
                            " changes one without the other, since ", grouping.reason, ", so that ",
                            grouping.consequence, " would be wrong; ", grouping.wayOut, ", or remove ", name);
        }
    }
}

} // namespace

void OpenMMVRattle::requireSuitableSystem(ContextImpl& context, const IntegratorSettings& settings) {
    const System& system = context.getSystem();
    requireMasses(system, settings);
    requireConstraints(system, settings);
    requireExpressions(system, settings);
    for (const ForceImpl* force : context.getForceImpls()) {
        refuseDrudeParticles(*force, settings);
        if (!settings.expressions.empty())
            requireKnownGroups(context, *force, settings);
    }
}
