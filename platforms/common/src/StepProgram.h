// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_STEPPROGRAM_H_
#define OPENMMVRATTLE_STEPPROGRAM_H_

#include "ExpressionClusters.h"
#include "LargeClusters.h"
#include "step/AutomaticControl.h"
#include "step/StepDensity.h"
#include "step/StepMonitor.h"
#include <map>
#include <string>
#include <vector>

namespace OpenMMVRattle {

/** The number of a word that host and device share; see StepProgram.cpp for the words. */
namespace Control {
/** The control block: what changes from step to step. The values of the monitors follow. */
enum Field {
    Density,       // rho[n-1/2]
    StepSize,      // of the last step
    Elapsed,       // the time since the host has looked last, and what its rounding has left
    ElapsedRest,
    Steps,         // since the host has looked last
    Rescues,       // likewise
    U,             // u(q[n],p[n]), once evaluateState() has found it
    HalfU,         // u(q[n],p[n-1/2]), where IsHalfKnown says so; else it is in the sums
    IsHalfKnown,
    DensityOffset, // what (3.14) and (3.15) differed by in the last step
    DensityScale,  // by which u and rho change where parameters of expressions begin to move, or stop; else 1
    MismatchSlope, // of (3.14) as a function of the density, in the last step
    IsShortened,   // the last step was cut short
    MostTrials,    // of a density, since the host has looked last
    Reference,     // of Langevin dynamics: U_ref
    IsFollowed,    // likewise: it has followed U
    FirstValue     // U_k
};
/** With automatic step control other numbers follow, and a word whether they are those at the end of the last step. */
const int NumAutomaticNumbers = sizeof(AutomaticRecursions::AutomaticNumbers) / sizeof(double);
const int FirstReference = FirstValue, FirstNumber = FirstReference + AutomaticControl::NUM_MONITORS;
const int IsAccepted = FirstNumber + NumAutomaticNumbers;
/** Whether velocities have jumped in the last step, or will in the next, since parameters of expressions begin to move, or stop. */
const int IsJump = IsAccepted + 1, IsJumpAhead = IsJump + 1, AutomaticSize = IsJumpAhead + 1;
/**
 * The settings; the weight, the power and the reference value of each monitor follow, or with automatic step control the choices of its
 * recursions, and 1/f, by which twice the kinetic energy is multiplied.
 */
enum Setting {
    Nominal,  // h
    Smallest, // a = h/maximum
    Lower,    // B(u) = (Lower + Slope u)/(1 + Curve u)
    Slope,
    Curve,
    DensityTolerance, // of (3.14), relative
    DensityRounding,  // the same where rounding allows no better
    Damping, // of Langevin dynamics: a, sqrt(kT (1 - a^2)), the bound and the factor of U_ref, the largest U/U_ref of a calm step
    NoiseSize,
    ReferenceFloor,
    Following,
    LargestCalm,
    FirstTerm
};
/** What makes a step fail; the slot of the cluster is above. Irregular are constraints that depend on each other, and forces. */
enum Failure { NotConverged, InvalidMonitor, Irregular, UnsolvedDensity, NumCodes };
const int NumAutomaticChoices = sizeof(AutomaticRecursions::AutomaticChoice) / sizeof(double);
/** What others have changed between two steps. */
enum Change { NothingChanged, AllChanged, VelocitiesChanged, ForcesChanged };
/** Numbers of the trial of a density. */
const int TrialSize = 9;
} // namespace Control

/**
 * The text of the device's program, in OpenMM's common language for CUDA, OpenCL and HIP. It depends on the constraint graphs, on
 * which sums the monitors need and on the update, and on no number that a user changes in mid-run without changing those.
 */
class StepProgram {
public:
    enum Update { Fixed, Sum, Bounded, SemiExplicit, Automatic, Langevin };
    /** Where the data of a kind lie. */
    struct Place {
        int firstSlot, firstAtom, firstLength;
    };
    static const int SLOT_UNIT = 32;
    /**
     * Of a large cluster: an iteration that takes longer is left to Newton's, or to the host. There are two in a step of Langevin dynamics. Stages that
     * nobody needs cost nothing, unless each is a launch.
     */
    static constexpr int getMaxStages(Update update, bool isStaged) {
        return update != Langevin ? 16 : isStaged ? 28 : 60;
    }

    /**
     * @param layout        the clusters, of which small ones are for one thread each
     * @param large         those of more distances
     * @param expressions   those with constraints given as expressions, or null
     * @param newton        the large ones once more, for Newton's iteration where the chord's fails, or null
     * @param numThreads    of a group that works on one of the last two
     * @param terms         the monitors; none with automatic step control, and Langevin dynamics has its own, the only one
     * @param update        how the density is found
     * @param isMixed       whether positions and velocities are in double precision
     * @param isWide        whether the device has doubles
     */
    StepProgram(const ClusterLayout& layout, const LargeClusters& large, const ExpressionClusters* expressions,
                const ExpressionClusters* newton, int numThreads, const std::vector<StepMonitor::Term>& terms,
                Update update, bool isMixed, bool isWide);
    /** The clusters that are small and free particles, in the order of their slots: those with most constraints first. */
    static std::vector<const ClusterKind*> findSmallKinds(const ClusterLayout& layout);
    /** The threads of a work group. */
    static int getGroupSize(bool hasSharedClusters) {
        return hasSharedClusters ? 128 : 64;
    }
    /** The update as a device sees it: what does not depend on velocities needs no iteration. */
    static Update updateOf(const std::vector<StepMonitor::Term>& terms, bool isFixedStep, StepDensity::Update update);
    const std::string& getSource() const {
        return source;
    }
    /** Macros to be defined before the text. */
    const std::map<std::string, std::string>& getDefines() const {
        return defines;
    }
    const std::vector<Place>& getPlaces() const {
        return places;
    }
    /** The number of threads that have something to do. */
    int getNumSlots() const {
        return numSlots;
    }
    /** The number of sums that each work group leaves. */
    int getNumSums() const {
        return numSums;
    }
    bool hasHalfSums() const {
        return update == SemiExplicit;
    }
    /** Whether the density follows monitors, which jump where parameters of expressions begin to move, or stop. */
    bool hasJumps() const {
        return update != Fixed && update != Langevin;
    }
    /** Whether parameters are wanted in the middle of a step too. */
    bool hasMiddle() const {
        return update == Langevin;
    }
    /** Words of the control block and of the settings. */
    int getControlSize() const {
        return update == Automatic ? Control::AutomaticSize : Control::FirstValue + numMonitors;
    }
    int getNumSettings() const {
        return Control::FirstTerm + (update == Automatic ? Control::NumAutomaticChoices + 1 : 3 * numMonitors);
    }

private:
    void writeMonitors(const std::vector<StepMonitor::Term>& terms);
    int writeClusters(const std::vector<const ClusterKind*>& kinds, int mostKept);
    void writeLargeClusters(const LargeClusters& large, int bytesKept);
    void writeAutomaticControl(int numPieces);
    void writeExpressions(const ExpressionClusters* expressions, const ExpressionClusters* newton);
    std::string source;
    std::map<std::string, std::string> defines, words;
    std::vector<Place> places;
    int numMonitors, numSlots, numSums;
    Update update;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_STEPPROGRAM_H_
