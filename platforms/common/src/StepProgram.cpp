// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "StepProgram.h"
#include "ClusterAlgebra.h"
#include "DeviceSources.h"
#include "constraints/ConstraintMatrix.h"
#include "constraints/ParameterMotion.h"
#include "step/LangevinDynamics.h"
#include "step/MonitorControl.h"
#include <algorithm>
#include <cmath>
#include <sstream>

using namespace OpenMMVRattle;
using std::map;
using std::string;
using std::to_string;
using std::vector;

namespace {

const int MANY_ENTRIES = 16; // of the matrix of Newton's iteration
const int MOST_IN_REGISTERS = 6; // constraints; of more the distance vectors are in local memory
const int MAX_ITERATIONS = 20, LARGEST_POWER = 64;
// Of a part with expressions: where so many chord iterations do not converge Newton's follow.
const int MAX_CHORD_ITERATIONS = 12, MAX_PART_ITERATIONS = 100;
// Of a group that waits for others, about 0.2 s; they come within microseconds.
const int MAX_POLLS = 1 << 18;

void replaceAll(string& text, const string& from, const string& to) {
    for (size_t at = text.find(from); at != string::npos; at = text.find(from, at + to.size()))
        text.replace(at, from.size(), to);
}

string literal(double value) {
    std::stringstream text;
    text.precision(17);
    text << std::scientific << value;
    return text.str();
}

// x^n by squaring.
string writePower(int n) {
    string text = "mixed result = 1, square = x;\n";
    for (; n > 0; n /= 2) {
        if (n % 2 == 1)
            text += "    result *= square;\n";
        if (n > 1)
            text += "    square *= square;\n";
    }
    return text + "    return result;";
}

// The sums of the monitors that are wanted, and what each takes.
enum Quantity {
    MultiplierSquares, // sum Lambda^2, of g = |r|^2 - L^2
    ConstraintWork,    // Lambda^T K Lambda
    AppliedSquares,    // sum |F|^2/m
    MultiplierPowers,
    ForcePowers,
    ForceSquares,
    KineticSquares, // sum m |v|^2
    SpeedSquares,   // sum |v|^2
    LargestForce,   // max |F|^2
    LargestArc,     // max |F|^2 + |v|^2
    ClusterPowers,  // sum A_c^4 of Langevin dynamics
    Failures,       // of trials
    // Of automatic step control, which adds them up itself (kernels/automatic.cc)
    HardnessOnStep, // sum A_c^4
    HardnessOnHalfStep,
    AutomaticKinetic,
    AutomaticChange,
    AutomaticScale
};
// A p-norm takes two places, and so do fourth powers of sums over the particles of a cluster, for the pieces of large clusters.
enum Merge { Add, Largest, Power, FourthPowers };
struct QuantityText {
    Merge merge;
    bool ofConstraint;
    const char* term; // added to it
};
const map<Quantity, QuantityText> QUANTITIES = {
    {MultiplierSquares, {Add, true, "lambda*lambda/4"}},
    {ConstraintWork, {Add, true, "lambda*rightSide"}},
    {AppliedSquares, {Add, false, "w*forceSquared"}},
    {MultiplierPowers, {Power, true, "fabs(lambda)/2"}},
    {ForcePowers, {Power, false, "sqrt(forceSquared)"}},
    {ForceSquares, {Add, false, "forceSquared"}},
    {KineticSquares, {Add, false, "dot3(v, v)/w"}},
    {SpeedSquares, {Add, false, "dot3(v, v)"}},
    {LargestForce, {Largest, false, "forceSquared"}},
    {LargestArc, {Largest, false, "forceSquared + dot3(v, v)"}},
    {ClusterPowers, {FourthPowers, false, "(netSquared + sqrt(netSquared)*dot3(v, v)/FLIGHT_LENGTH)/w"}},
    {Failures, {Add, false, nullptr}},
    {HardnessOnStep, {Add, false, nullptr}},
    {HardnessOnHalfStep, {Add, false, nullptr}},
    {AutomaticKinetic, {Add, false, nullptr}},
    {AutomaticChange, {Add, false, nullptr}},
    {AutomaticScale, {Add, false, nullptr}}};

struct MonitorText {
    vector<Quantity> quantities;
    string value; // in which $0 and $1 stand for the sums
};
// U = (sum_c A_c^4)^(1/8)
const MonitorText NET_FORCES = {{ClusterPowers}, "($0b == 0 ? eighthRoot($0) : (wide) -1)"};
const map<StepMonitor::Kind, MonitorText> MONITORS = {
    {StepMonitor::ConstraintMultipliers, {{MultiplierSquares}, "sqrt($0)"}}, // (4.4)
    {StepMonitor::ConstraintForce, {{ConstraintWork}, "sqrt(max($0, (wide) 0))"}},
    {StepMonitor::AppliedForce, {{AppliedSquares}, "sqrt($0)"}},
    {StepMonitor::ConstraintAndAppliedForce, {{ConstraintWork, AppliedSquares}, "sqrt(max($0, (wide) 0) + $1)"}},
    {StepMonitor::MultiplierPNorm, {{MultiplierPowers}, "$0*pow($0b, (wide) $p)"}},
    {StepMonitor::ForcePNorm, {{ForcePowers}, "$0*pow($0b, (wide) $p)"}},
    {StepMonitor::VectorField, {{ForceSquares, KineticSquares}, "sqrt($0 + $1)"}}, // (4.1)
    {StepMonitor::MaxForce, {{LargestForce}, "sqrt($0)"}},
    {StepMonitor::ArcLength, {{ForceSquares, SpeedSquares}, "sqrt($0 + $1)"}},
    {StepMonitor::MaxParticleArcLength, {{LargestArc}, "sqrt($0)"}},
    {StepMonitor::ForceGroupEnergy, {{}, "groupEnergy"}}};

} // namespace

StepProgram::Update StepProgram::updateOf(const vector<StepMonitor::Term>& terms, bool isFixedStep,
                                          StepDensity::Update update) {
    if (isFixedStep || terms.empty())
        return Fixed;
    if (update == StepDensity::Bounded)
        return Bounded;
    return update == StepDensity::SemiExplicit && StepMonitor::dependOnVelocities(terms) ? SemiExplicit : Sum;
}

vector<const ClusterKind*> StepProgram::findSmallKinds(const ClusterLayout& layout) {
    vector<const ClusterKind*> result;
    for (const ClusterKind& kind : layout.kinds)
        if (kind.isSmall() && kind.getNumClusters() > 0)
            result.push_back(&kind);
    std::stable_sort(result.begin(), result.end(), [](const ClusterKind* a, const ClusterKind* b) {
        return a->getNumConstraints() > b->getNumConstraints();
    });
    return result;
}

StepProgram::StepProgram(const ClusterLayout& layout, const LargeClusters& large, const ExpressionClusters* expressions,
                         const ExpressionClusters* newton, int numThreads, const vector<StepMonitor::Term>& terms,
                         Update update, bool isMixed, bool isWide) : numMonitors((int) terms.size()), update(update) {
    const bool areShared = !large.isEmpty() || expressions != nullptr;
    if (areShared)
        defines["NUM_THREADS"] = to_string(numThreads);
    writeMonitors(terms);
    if (areShared && update == Automatic)
        // A piece leaves those of its cluster, and of how many pieces that is.
        numSums = std::max(numSums, ExpressionClusters::NUM_TERMS + 1);
    const int bytesOfGroup = getGroupSize(areShared) * (isMixed ? 8 : 4); // for one number of each thread
    const int numKept = writeClusters(findSmallKinds(layout), large.getLocalMemory() / bytesOfGroup);
    writeLargeClusters(large, numKept * bytesOfGroup);
    words["EXPRESSION_CLUSTERS"] = "";
    if (expressions != nullptr || newton != nullptr)
        writeExpressions(expressions, newton);
    writeAutomaticControl((int) large.getPieces().size());
    words["LANGEVIN_FUNCTIONS"] = update == Langevin
                                      ? DeviceSources::langevin
                                      : "#define NOISE_PARAMETERS\n#define NOISE_ARGUMENTS\n#define NO_NOISE\n"
                                        "#define NOISE_STATE\n#define LARGE_NOISE_STATE\n";
    source = DeviceSources::step;
    for (const auto& word : words)
        replaceAll(source, word.first, word.second);
    const map<string, int> numbers = {{"GROUP_SIZE", getGroupSize(areShared)},
                                      {"HAS_EXPRESSIONS", expressions != nullptr},
                                      {"HAS_NEWTON", newton != nullptr},
                                      {"FIXED", Fixed},
                                      {"SUM", Sum},
                                      {"BOUNDED", Bounded},
                                      {"SEMI_EXPLICIT", SemiExplicit},
                                      {"AUTOMATIC", Automatic},
                                      {"LANGEVIN", Langevin},
                                      {"UPDATE", update},
                                      {"HALF_SUMS", update == SemiExplicit ? 1 : 0},
                                      {"NUM_DRIFTS", update == Langevin ? 2 : 1},
                                      {"NUM_MONITORS", (int) terms.size()},
                                      {"NUM_VALUES", std::max(1, (int) terms.size())},
                                      {"NUM_SUMS", numSums},
                                      {"DENSITY", Control::Density},
                                      {"STEP_SIZE", Control::StepSize},
                                      {"ELAPSED", Control::Elapsed},
                                      {"ELAPSED_REST", Control::ElapsedRest},
                                      {"STEPS", Control::Steps},
                                      {"RESCUES", Control::Rescues},
                                      {"MONITOR_U", Control::U},
                                      {"HALF_U", Control::HalfU},
                                      {"IS_HALF_KNOWN", Control::IsHalfKnown},
                                      {"DENSITY_OFFSET", Control::DensityOffset},
                                      {"DENSITY_SCALE", Control::DensityScale},
                                      {"MISMATCH_SLOPE", Control::MismatchSlope},
                                      {"IS_SHORTENED", Control::IsShortened},
                                      {"MOST_TRIALS", Control::MostTrials},
                                      {"REFERENCE", Control::Reference},
                                      {"IS_FOLLOWED", Control::IsFollowed},
                                      {"FIRST_VALUE", Control::FirstValue},
                                      {"CONTROL_SIZE", getControlSize()},
                                      {"NOMINAL", Control::Nominal},
                                      {"SMALLEST", Control::Smallest},
                                      {"LOWER", Control::Lower},
                                      {"SLOPE", Control::Slope},
                                      {"CURVE", Control::Curve},
                                      {"DENSITY_TOLERANCE", Control::DensityTolerance},
                                      {"DENSITY_ROUNDING", Control::DensityRounding},
                                      {"DAMPING", Control::Damping},
                                      {"NOISE_SIZE", Control::NoiseSize},
                                      {"REFERENCE_FLOOR", Control::ReferenceFloor},
                                      {"FOLLOWING", Control::Following},
                                      {"LARGEST_CALM", Control::LargestCalm},
                                      {"FIRST_TERM", Control::FirstTerm},
                                      {"NOT_CONVERGED", Control::NotConverged},
                                      {"INVALID_MONITOR", Control::InvalidMonitor},
                                      {"IRREGULAR", Control::Irregular},
                                      {"UNSOLVED_DENSITY", Control::UnsolvedDensity},
                                      {"NUM_CODES", Control::NumCodes},
                                      {"TRIAL_STATUS", 0},
                                      {"TRIAL_U", 1},
                                      {"TRIAL_PREVIOUS", 2},
                                      {"TRIAL_HALF_U", 3},
                                      {"TRIAL_DENSITY", 4},
                                      {"TRIAL_LAST_DENSITY", 5},
                                      {"TRIAL_LAST_MISMATCH", 6},
                                      {"TRIAL_COUNT", 7},
                                      {"TRIAL_SLOPE", 8},
                                      {"TRIAL_SIZE", Control::TrialSize},
                                      {"TRYING", 0},
                                      {"CONVERGED", 1},
                                      {"UNSOLVED", 2},
                                      {"MAX_ITERATIONS", MAX_ITERATIONS}};
    for (const auto& number : numbers)
        defines[number.first] = to_string(number.second);
    defines["WIDE"] = isWide ? "double" : "float";
    // A float has lost the sign of a pivot below this fraction.
    defines["MIN_PIVOT"] = isMixed ? literal(ConstraintMatrix::MIN_RELATIVE_PIVOT) : "1e-5f";
    // Of large clusters, whose factor is in the type of forces.
    defines["MIN_LARGE_PIVOT"] = "(sizeof(real) > 4 ? " + literal(ConstraintMatrix::MIN_RELATIVE_PIVOT) + "f : 1e-5f)";
    defines["SLOPE_ROUNDING"] = isMixed ? "1e-11" : "1e-4f";
    defines["MARGIN"] = "0.1f";
    defines["SLOW_CONVERGENCE"] = "0.25f";
    defines["BOUND_MARGIN"] = literal(StepDensity::DOMAIN_MARGIN);
    defines["SLIVER"] = "1e-6f";
    defines["LARGEST_FOURTH_POWER"] = isMixed ? "1e280" : "1e36f";
    defines["LARGEST_OF_FOURTH_POWERS"] = isMixed ? "1e70" : "1e9f";
    defines["FLIGHT_LENGTH"] = "(mixed) " + literal(LangevinDynamics::FLIGHT_LENGTH) + (isMixed ? "" : "f");
}

// The sums that the monitors need, each once. A p-norm's sum takes two places.
void StepProgram::writeMonitors(const vector<StepMonitor::Term>& terms) {
    typedef std::pair<Quantity, double> Key; // with the order of a p-norm, else 0
    map<Key, int> places;
    numSums = 0;
    auto keyOf = [](Quantity quantity, double order) {
        const Merge merge = QUANTITIES.at(quantity).merge;
        return Key(quantity, merge == Power ? order : 0.0);
    };
    auto add = [&](const Key& key) {
        if (places.count(key) == 0) {
            places[key] = numSums;
            const Merge merge = QUANTITIES.at(key.first).merge;
            numSums += merge == Power || merge == FourthPowers ? 2 : 1;
        }
        return places[key];
    };
    string values;
    for (size_t k = 0; k < terms.size(); k++) {
        const MonitorText& monitor = update == Langevin ? NET_FORCES : MONITORS.at(terms[k].kind);
        string value = monitor.value;
        for (size_t i = 0; i < monitor.quantities.size(); i++) {
            const int place = add(keyOf(monitor.quantities[i], terms[k].order));
            replaceAll(value, "$" + to_string(i) + "b", "(wide) sums[" + to_string(place + 1) + "]");
            replaceAll(value, "$" + to_string(i), "(wide) sums[" + to_string(place) + "]");
        }
        replaceAll(value, "$p", literal(1 / terms[k].order));
        values += "values[" + to_string(k) + "] = " + value + ";\n    ";
    }
    if (update == Automatic) {
        defines["SUM_ON_STEP"] = to_string(add(Key(HardnessOnStep, 0)));
        defines["SUM_HALF_STEP"] = to_string(add(Key(HardnessOnHalfStep, 0)));
        defines["SUM_KINETIC"] = to_string(add(Key(AutomaticKinetic, 0)));
        defines["SUM_CHANGE"] = to_string(add(Key(AutomaticChange, 0)));
        defines["SUM_SCALE"] = to_string(add(Key(AutomaticScale, 0)));
    }
    if (hasHalfSums() || numSums == 0) // an array has at least one element
        defines["FAILURES"] = to_string(add(Key(Failures, 0)));
    string constraintTerms, particleTerms, clusterTerms, shareTerm, mergeTerms, powers;
    map<double, int> orders; // each with a number for its functions
    for (const auto& entry : places) {
        const QuantityText& quantity = QUANTITIES.at(entry.first.first);
        const string sum = "sums[" + to_string(entry.second) + "]", other = "other[" + to_string(entry.second) + "]";
        string& text = quantity.ofConstraint ? constraintTerms : particleTerms;
        const string address = to_string(entry.second);
        switch (quantity.merge) {
        case Add:
            if (quantity.term != nullptr)
                text += sum + " += " + quantity.term + ";\n    ";
            mergeTerms += sum + " += " + other + ";\n    ";
            break;
        case Largest:
            text += sum + " = max(" + sum + ", " + quantity.term + ");\n    ";
            mergeTerms += sum + " = max(" + sum + ", " + other + ");\n    ";
            break;
        case Power: {
            const string name =
                "Power_" + to_string(orders.insert({entry.first.second, (int) orders.size()}).first->second);
            text += "add" + name + "(sums + " + address + ", " + quantity.term + ");\n    ";
            mergeTerms += "merge" + name + "(sums + " + address + ", other + " + address + ");\n    ";
            break;
        }
        case FourthPowers: {
            const string piece = to_string(entry.second + 1);
            clusterTerms += "addFourthPower(sums + " + address + ", share);\n    ";
            mergeTerms += sum + " += " + other + ";\n    sums[" + piece + "] += other[" + piece + "];\n    ";
            shareTerm = quantity.term;
            defines["PIECE_COUNT"] = address;
            defines["PIECE_SHARE"] = piece;
            break;
        }
        }
    }
    defines["CLUSTER_SUMS"] = shareTerm.empty() ? "0" : "1";
    words["CLUSTER_TERMS"] = clusterTerms;
    words["SHARE_TERM"] = shareTerm;
    words["CONSTRAINT_TERMS"] = constraintTerms;
    words["PARTICLE_TERMS"] = particleTerms;
    words["MERGE_TERMS"] = mergeTerms;
    words["MONITOR_VALUES"] = values;
    for (const auto& order : orders) {
        const double p = order.first;
        const bool isWhole = p == std::floor(p) && p <= LARGEST_POWER;
        string text = DeviceSources::power;
        replaceAll(text, "RAISE", isWhole ? writePower((int) p) : "return pow(x, (mixed) " + literal(p) + ");");
        replaceAll(text, "_ORDER", "_" + to_string(order.second));
        powers += text;
    }
    words["POWER_FUNCTIONS"] = powers;
}

// Returns how many numbers of a thread are in local memory, of those for which there is room.
int StepProgram::writeClusters(const vector<const ClusterKind*>& kinds, int mostKept) {
    string functions, finishCases, trialCases, advanceCases;
    numSlots = 0;
    int numAtoms = 0, numLengths = 0, numKept = 0;
    for (size_t i = 0; i < kinds.size(); i++) {
        const ClusterKind& kind = *kinds[i];
        const int count = kind.getNumClusters(), numConstraints = kind.getNumConstraints();
        const string name = "_" + to_string(i);
        places.push_back({numSlots, numAtoms, numLengths});
        string text = numConstraints == 0 ? DeviceSources::particle : DeviceSources::cluster;
        if (numConstraints > 0) {
            const ClusterAlgebra algebra(kind);
            string first, second;
            for (const vector<int>& pair : kind.particlesOf) {
                first += (first.empty() ? "" : ", ") + to_string(pair[0]);
                second += (second.empty() ? "" : ", ") + to_string(pair[1]);
            }
            text.erase(0, text.find("\ninline ") + 1); // the explanation
            replaceAll(text, "CLUSTER_ALGEBRA", algebra.write());
            replaceAll(text, "FIRST_ATOMS", "{" + first + "}");
            replaceAll(text, "SECOND_ATOMS", "{" + second + "}");
            // A matrix of many entries, whose rounding another iteration mends, takes half the registers in single precision, or
            // in the type of forces.
            const bool isInLocalMemory = numConstraints > MOST_IN_REGISTERS && 4 * numConstraints <= mostKept;
            const bool areMany = 2 * algebra.getNumEntries() - numConstraints > MANY_ENTRIES;
            replaceAll(text, "FACTOR", !areMany ? "mixed" : isInLocalMemory ? "float" : "real");
            replaceAll(text, "MAKE_VECTORS",
                       isInLocalMemory ? "VECTORS r = kept + LOCAL_ID;" : "mixed r[4*NUM_CONSTRAINTS];");
            replaceAll(text, "VECTORS", isInLocalMemory ? "LOCAL_ARG volatile mixed*" : "mixed*");
            replaceAll(text, "STRIDE", isInLocalMemory ? "GROUP_SIZE" : "1");
            if (isInLocalMemory)
                numKept = std::max(numKept, 4 * numConstraints);
            replaceAll(text, "NUM_ENTRIES", to_string(algebra.getNumEntries()));
        }
        for (const auto& word : map<string, int>{{"NUM_ATOMS", kind.numParticles},
                                                 {"NUM_CONSTRAINTS", numConstraints},
                                                 {"NUM_CLUSTERS", count},
                                                 {"ATOM_BASE", numAtoms},
                                                 {"LENGTH_BASE", numLengths}})
            replaceAll(text, word.first, to_string(word.second));
        replaceAll(text, "_KIND", name);
        functions += text;
        // A warp has clusters of one kind only.
        const int next = numSlots + (count + SLOT_UNIT - 1) / SLOT_UNIT * SLOT_UNIT;
        const string head = string(i == 0 ? "" : "else ") + "if (slot < " + to_string(next) + ") {\n            " +
                            "const int c = slot - " + to_string(numSlots) + ";\n            if (c < " +
                            to_string(count) + ")\n                ";
        const string tail = ";\n        }\n        ";
        finishCases +=
            head + "isRegular = finish" + name +
            "(c, CLUSTER_ARGUMENTS, kick*dt, halfKick, formHalf, isStored != 0, sums, halfSums LAST_STATE_ARGUMENT)" +
            tail;
        trialCases += head + "isSolved = try" + name + "(c, CLUSTER_ARGUMENTS, dt, tolerance, sums)" + tail;
        advanceCases += head + "iterations = advance" + name +
                        "(c, CLUSTER_ARGUMENTS, kick, drift, tolerance, oldPositions, oldVelocities NOISE_ARGUMENTS)" +
                        tail;
        numSlots = next;
        numAtoms += count * kind.numParticles;
        numLengths += count * numConstraints;
    }
    defines["NUM_KEPT"] = to_string(numKept);
    words["CLUSTER_FUNCTIONS"] = functions;
    words["FINISH_CASES"] = finishCases;
    words["TRIAL_CASES"] = trialCases;
    words["ADVANCE_CASES"] = advanceCases;
    return numKept;
}

void StepProgram::writeLargeClusters(const LargeClusters& large, int bytesKept) {
    const LargeClusters::Form& form = large.getForm();
    words["LARGE_CLUSTERS"] =
        large.isEmpty() ? "#define FUSED_PARAMETERS\n#define FUSED_MEMORY\n" : DeviceSources::large;
    defines["IS_FUSED"] = form.isFused ? "1" : "0";
    defines["NUM_PIECES"] = to_string(large.getPieces().size());
    defines["NUM_FUSED"] = to_string(form.isFused ? large.getPieces().size() : 0);
    defines["MAX_STAGES"] = to_string(getMaxStages(update, form.isStaged));
    if (large.isEmpty())
        return;
    const bool hasNarrow = large.getNarrow() > 0;
    defines["USE_RECORDS"] = form.areRecords ? "1" : "0";
    defines["HAS_JOINTS"] = form.hasJoints ? "1" : "0";
    defines["IN_LOCAL_MEMORY"] = form.isInLocalMemory ? "1" : "0";
    defines["MEMORY"] = form.isInLocalMemory ? "LOCAL_ARG" : "GLOBAL";
    // Groups of a launch that have no piece keep the vectors of small clusters there.
    const int wordsKept = form.isFused ? bytesKept / 16 : 0;
    defines["SHARED_SIZE"] = to_string(form.isInLocalMemory ? std::max(large.getLocalSize(), wordsKept) : 1);
    defines["NARROW"] = hasNarrow ? to_string(large.getNarrow()) : "NUM_THREADS";
    defines["SYNC_NARROW"] = hasNarrow ? "__syncwarp()" : "SYNC_PIECE";
    defines["MAX_POLLS"] = to_string(form.isStaged ? 1 : MAX_POLLS);
}

void StepProgram::writeAutomaticControl(int numPieces) {
    string& text = words["AUTOMATIC_CONTROL"];
    const bool isAutomatic = update == Automatic;
    defines["NUM_APART"] = to_string(isAutomatic ? numPieces : 0);
    if (!isAutomatic) {
        for (const char* empty : {"LAST_STATE_PARAMETERS", "LAST_STATE_PARAMETER", "LAST_STATE_ARGUMENT",
                                  "MAKE_LAST_STATE(kick, dt, change)"})
            text += string("#define ") + empty + "\n";
        return;
    }
    text = DeviceSources::automatic;
    replaceAll(text, "AUTOMATIC_RECURSIONS", DeviceSources::AutomaticRecursions);
    const map<string, int> numbers = {{"NUM_PIECES", numPieces},
                                      {"NUM_TERMS", ExpressionClusters::NUM_TERMS},
                                      {"NUM_CHOICES", Control::NumAutomaticChoices},
                                      {"NUM_NUMBERS", Control::NumAutomaticNumbers},
                                      {"FIRST_REFERENCE", Control::FirstReference},
                                      {"FIRST_NUMBER", Control::FirstNumber},
                                      {"IS_ACCEPTED", Control::IsAccepted},
                                      {"IS_JUMP", Control::IsJump},
                                      {"IS_JUMP_AHEAD", Control::IsJumpAhead},
                                      {"ALL_CHANGED", Control::AllChanged},
                                      {"VELOCITIES_CHANGED", Control::VelocitiesChanged},
                                      {"FORCES_CHANGED", Control::ForcesChanged}};
    for (const auto& number : numbers)
        defines[number.first] = to_string(number.second);
    defines["LENGTH_WEIGHT"] = literal(1 / AutomaticControl::LENGTH);
    defines["FLIGHT_WEIGHT"] = literal(1 / (AutomaticControl::FLIGHT * AutomaticControl::FLIGHT));
    defines["CHANGE_WEIGHT"] = literal(AutomaticControl::CHANGE_WEIGHT);
}

void StepProgram::writeExpressions(const ExpressionClusters* expressions, const ExpressionClusters* newton) {
    string& text = words["EXPRESSION_CLUSTERS"];
    text = DeviceSources::expression;
    if (expressions != nullptr)
        text += DeviceSources::moving;
    if (newton != nullptr)
        text += DeviceSources::newton;
    replaceAll(text, "EXPRESSION_FUNCTIONS", (expressions != nullptr ? expressions : newton)->writeFunctions());
    defines["EXPRESSION_LENGTH"] = literal(ConstraintSystem::EXPRESSION_LENGTH);
    defines["MAX_CHORD_ITERATIONS"] = to_string(MAX_CHORD_ITERATIONS);
    defines["SMALLEST_SHARE"] = "1e-4f";
    defines["PART_TERMS"] = to_string(ExpressionClusters::NUM_TERMS);
    defines["MAX_PART_ITERATIONS"] = to_string(MAX_PART_ITERATIONS);
    defines["SUDDEN_CHANGE"] = to_string(ParameterMotion::SUDDEN_CHANGE) + "f";
    defines["SMALL_CHANGE"] = to_string(MonitorControl::SMALL_CHANGE) + "f";
    defines["SMALL_JUMP"] = literal(ParameterMotion::SMALL_JUMP) + "f";
}
