// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "LargeClusters.h"
#include <algorithm>
#include <cstdint>
#include <map>
#include <memory>

using namespace OpenMMVRattle;
using std::map;
using std::pair;
using std::vector;

namespace {

// The numbers at the beginning of a piece's tables; kernels/large.cc has the same. Offsets are counted in items of the list.
enum Header {
    NumLevels,
    NumWide,
    NumCouplings,
    Couplings,
    IncidenceStart,
    IncidenceList,
    LevelStarts,
    More, // with records
    Borders,
    JointLevelStarts,
    JointMore,
    SourceStart,
    Sources,
    NumJointLevels,
    NumJointEntries,
    NumBorderEntries,
    FirstContribution,
    FirstBorderEntry,
    ColumnStart = More, // with rows
    EntryRow,
    EntryColumn,
    RowStart,
    RowEntry,
    RowColumn,
    Ends = FirstBorderEntry + 1,
    HEADER_SIZE = 20
};

const int LARGEST_INDEX = 65535, LARGEST_TABLE = 1 << 18; // bytes
const int MANY_JOINTS = 1024, SMALLEST_PIECE = 24;
// As in kernels/large.cc.
const int SPLIT = 8;
// A cluster of so many pieces is left whole, unless it does not fit into local memory.
const double FEW_PIECES = 2.5;

int roundUp(size_t value, int unit) {
    return (int) ((value + unit - 1) / unit * unit);
}

// Lists of 16-bit and 32-bit numbers behind each other.
class Writer {
public:
    explicit Writer(bool isShort) : words(HEADER_SIZE, 0), isShort(isShort) {
    }
    int addWords(const vector<int>& items) {
        const size_t start = words.size();
        words.insert(words.end(), items.begin(), items.end());
        return (int) start;
    }
    // Of numbers that are short with records.
    int addIndices(const vector<int>& items) {
        if (!isShort)
            return addWords(items);
        const size_t start = words.size();
        for (size_t i = 0; i < items.size(); i += 2)
            words.push_back((unsigned) items[i] | (i + 1 < items.size() ? (unsigned) items[i + 1] << 16 : 0));
        return (int) (2 * start);
    }
    // Returns the number of the first, counted in records.
    int addRecord(const vector<int>& items) {
        const size_t start = words.size();
        for (int i = 0; i < 8; i += 2) {
            auto item = [&](int j) { return j < (int) items.size() ? (unsigned) items[j] : 0; };
            words.push_back(item(i) | item(i + 1) << 16);
        }
        return (int) (start / 4);
    }
    int getNextRecord() const {
        return (int) (words.size() / 4);
    }
    void set(Header field, int value) {
        words[field] = (unsigned) value;
    }
    const vector<unsigned>& finish() {
        words.resize(roundUp(words.size(), 4));
        return words;
    }

private:
    vector<unsigned> words;
    bool isShort;
};

} // namespace

// The factor of a sparse matrix whose rows are in the order of elimination, outer rows excepted, which are behind.
struct LargeClusters::Elimination {
    const FactorColumns& columns;
    const MatrixEntries outer; // entries between outer rows, sorted
    int size, numOuter, numLevels;
    vector<int> levels; // the first place of each level

    Elimination(const vector<int>& levelOfRow, int numLevels, const FactorColumns& columns, int numOuter,
                const MatrixEntries& outer) :
            columns(columns), outer(outer), size(columns.getNumColumns()), numOuter(numOuter), numLevels(numLevels) {
        for (int place = 0; place < size; place++)
            while ((int) levels.size() <= levelOfRow[place])
                levels.push_back(place);
        levels.push_back(size);
    }
    int getNumRows() const {
        return size + numOuter;
    }
    int getNumEntries() const {
        return (int) columns.rows.size();
    }
    int getFirstOuterSlot() const {
        return getNumRows() + getNumEntries();
    }
    // Where the entry of two places is kept.
    int findSlot(int row, int column) const {
        if (column < size)
            return getNumRows() + (int) columns.find(row, column);
        const auto place = std::lower_bound(outer.begin(), outer.end(), pair<int, int>(row, column));
        return getFirstOuterSlot() + (int) (place - outer.begin());
    }
    bool isNarrow() const {
        for (int column = 0; column < size; column++)
            if (columns.getCount(column) >= (size_t) EliminationOrder::WIDE)
                return false;
        return true;
    }

    // The records of all levels, pass by pass; see applyRecord() in kernels/large.cc. Returns where each level's begin.
    vector<int> writeRecords(Writer& writer, int narrow, vector<int>& more, int& numWide) const {
        typedef vector<vector<int>> Level; // records
        vector<Level> passes[3];
        for (int level = 0; level < numLevels; level++) {
            map<int, vector<int>> entries, right; // for each number the products that are subtracted from it
            Level backward;
            for (int k = levels[level]; k < levels[level + 1]; k++) {
                const int *column = columns.begin(k), *end = columns.end(k);
                const int first = getNumRows() + (int) columns.start[k], count = (int) (end - column);
                for (int a = 0; a < count; a++) {
                    auto product = [&](int target, int b) {
                        entries[target].insert(entries[target].end(), {first + a, first + b, k});
                    };
                    right[column[a]].insert(right[column[a]].end(), {first + a, k});
                    product(column[a], a);
                    for (int b = 0; b < a; b++)
                        product(findSlot(column[a], column[b]), b);
                }
                vector<int> record = {k, count, first};
                record.insert(record.end(), column, count > 5 ? column + 3 : end);
                if (count > 5)
                    addMore(record, more, column + 3, end);
                backward.push_back(record);
            }
            passes[0].push_back(makeLevel(entries, 3, 2, 1, more));
            passes[1].push_back(makeLevel(right, 2, 3, 2, more));
            passes[2].push_back(backward);
        }
        std::reverse(passes[2].begin(), passes[2].end());
        numWide = numLevels;
        auto isNarrowLevel = [&](int level) {
            return (int) std::max({passes[0][level].size(), passes[1][level].size(),
                                   passes[2][numLevels - 1 - level].size()}) <= narrow;
        };
        while (numWide > 0 && isNarrowLevel(numWide - 1))
            numWide--;
        vector<int> starts;
        for (const vector<Level>& pass : passes) {
            for (const Level& level : pass) {
                starts.push_back(writer.getNextRecord());
                for (const vector<int>& record : level)
                    writer.addRecord(record);
            }
            starts.insert(starts.end(), 2, writer.getNextRecord());
        }
        return starts;
    }
    static void addMore(vector<int>& record, vector<int>& more, const int* begin, const int* end) {
        record.resize(6, 0);
        record.push_back((int) more.size() & 65535);
        record.push_back((int) more.size() >> 16);
        more.insert(more.end(), begin, end);
    }
    // Records of numbers to which products of so many factors belong; those with as many products are neighbours.
    static vector<vector<int>> makeLevel(const map<int, vector<int>>& targets, int numFactors, int numWithin,
                                         int numBeforeMore, vector<int>& more) {
        vector<pair<int, const vector<int>*>> sorted;
        for (const auto& target : targets)
            sorted.emplace_back(target.first, &target.second);
        std::stable_sort(sorted.begin(), sorted.end(),
                         [](const auto& a, const auto& b) { return a.second->size() < b.second->size(); });
        vector<vector<int>> level;
        for (const auto& target : sorted) {
            const vector<int>& factors = *target.second;
            const int count = (int) factors.size() / numFactors, within = count > numWithin ? numBeforeMore : count;
            vector<int> record = {target.first, count};
            record.insert(record.end(), factors.begin(), factors.begin() + within * numFactors);
            if (count > numWithin)
                addMore(record, more, factors.data() + within * numFactors, factors.data() + factors.size());
            level.push_back(record);
        }
        return level;
    }
};

// One piece of a cluster, by places of the kind.
struct LargeClusters::Layout {
    vector<int> constraints; // inner ones, then borders
    vector<int> particles;
    int numInner;
    vector<unsigned> tables;
    int numKept, factorSize, workSize;
    int firstContribution;
};

LargeClusters::LargeClusters(const ClusterLayout& layout, const Limits& limits) :
        form(), numThreads(limits.numThreads), narrow(limits.narrow), localMemory(limits.localMemory) {
    size_t total = 0;
    for (const ClusterKind* kind : findKinds(layout))
        if (kind->getNumConstraints() > FEW_PIECES * limits.pieceSize)
            total += kind->constraints.size();
    int pieceSize = limits.pieceSize;
    if (limits.numResident > 0)
        pieceSize = std::max(pieceSize, (int) (1.1 * (double) total / limits.numResident));
    build(layout, limits, pieceSize);
    // Smaller pieces may fit into local memory.
    for (int smaller = pieceSize * 3 / 4; isTooLarge() && smaller >= SMALLEST_PIECE; smaller = smaller * 3 / 4)
        build(layout, limits, smaller);
    if (isTooLarge() || form.isStaged)
        build(layout, limits, pieceSize);
    if (form.isInLocalMemory) {
        numFactors = numWork = 0;
        for (Piece& piece : pieces) {
            piece.firstKept = (int) numFactors;
            numFactors += piece.numKept;
            piece.firstWork = 0;
        }
    }
    // What is loaded in advance of need may lie behind the end.
    tables.resize(tables.size() + 4 * (size_t) (limits.numThreads + 1), 0);
}

vector<const ClusterKind*> LargeClusters::findKinds(const ClusterLayout& layout) {
    vector<const ClusterKind*> kinds;
    for (auto kind = layout.kinds.rbegin(); kind != layout.kinds.rend(); ++kind)
        if (!kind->isSmall() && !kind->hasExpressions)
            kinds.push_back(&*kind);
    return kinds;
}

// Whether it is in global memory for want of room alone.
bool LargeClusters::isTooLarge() const {
    return form.areRecords && !form.isStaged && !form.isInLocalMemory;
}

void LargeClusters::build(const ClusterLayout& layout, const Limits& limits, int pieceSize) {
    // Returns whether there was a place for all.
    auto addKinds = [&](bool areRecords, int size) {
        clear();
        form.areRecords = areRecords;
        const vector<const ClusterKind*> kinds = findKinds(layout);
        return std::all_of(kinds.begin(), kinds.end(),
                           [&](const ClusterKind* kind) { return addKind(layout, *kind, limits, size); });
    };
    if (!addKinds(true, pieceSize))
        addKinds(false, 0);
    form.hasJoints = numJoints > 0;
    const auto isJoined = [](const Piece& piece) { return piece.numJoints > 0; };
    form.isStaged =
        form.hasJoints && std::count_if(pieces.begin(), pieces.end(), isJoined) > std::max(limits.numResident, 0);
    form.isInLocalMemory = form.areRecords && !form.isStaged && 16 * localSize <= limits.localMemory;
    form.isFused = !pieces.empty() && form.isInLocalMemory && limits.numResident > 0 &&
                   2 * (int) pieces.size() <= limits.numGroups;
}

void LargeClusters::clear() {
    form = Form();
    pieces.clear();
    tables.clear();
    rows.clear();
    joints.clear();
    rowLengths.clear();
    jointLengths.clear();
    atoms.clear();
    constraints.clear();
    numConstraints = localSize = numLevels = numJoints = numJointLevels = 0;
    numFactors = numWork = numWords = numEntries = 0;
}

// Returns false if lists of records would be too long for it.
bool LargeClusters::addKind(const ClusterLayout& given, const ClusterKind& kind, const Limits& limits, int pieceSize) {
    const int count = kind.getNumConstraints();
    const vector<vector<int>>& particlesOf = kind.particlesOf;
    const ClusterElimination cluster =
        kind.eliminateInRounds(count > FEW_PIECES * pieceSize ? pieceSize : ClusterKind::WHOLE);
    const int numPieceJoints = (int) cluster.joints.size();
    if (numPieceJoints > MANY_JOINTS)
        return false;
    vector<int> pieceOf(kind.numParticles), placeOf(kind.numParticles);
    for (size_t p = 0; p < cluster.pieces.size(); p++)
        for (size_t i = 0; i < cluster.pieces[p].particles.size(); i++) {
            pieceOf[cluster.pieces[p].particles[i]] = (int) p;
            placeOf[cluster.pieces[p].particles[i]] = (int) i;
        }

    // Each piece alone; its joints are its outer rows.
    struct Part {
        vector<int> constraints; // of each row: inner ones, then borders
        vector<vector<int>> rowsOf; // of each particle
        std::unique_ptr<Elimination> elimination;
        map<pair<int, int>, vector<int>>
            couplings; // between rows: the particle's place, twice, + 1 where the signs differ
    };
    vector<Part> parts(cluster.pieces.size());
    for (size_t p = 0; p < parts.size(); p++) {
        Part& part = parts[p];
        const ClusterElimination::Piece& piece = cluster.pieces[p];
        part.constraints = piece.constraints;
        for (int joint : piece.borders)
            part.constraints.push_back(cluster.joints[joint]);
        part.rowsOf.resize(piece.particles.size());
        for (size_t row = 0; row < part.constraints.size(); row++)
            for (int i : particlesOf[part.constraints[row]])
                if (pieceOf[i] == (int) p)
                    part.rowsOf[placeOf[i]].push_back((int) row);
        for (size_t i = 0; i < part.rowsOf.size(); i++)
            for (int a : part.rowsOf[i])
                for (int b : part.rowsOf[i])
                    if (a > b) {
                        const int particle = piece.particles[i];
                        const bool differs = (particlesOf[part.constraints[a]][0] == particle) !=
                                             (particlesOf[part.constraints[b]][0] == particle);
                        part.couplings[{a, b}].push_back(2 * (int) i + differs);
                    }
        part.elimination.reset(new Elimination(piece.levels, piece.numLevels, piece.columns, (int) piece.borders.size(),
                                               piece.borderEntries));
        const Elimination& elimination = *part.elimination;
        if (form.areRecords && (!elimination.isNarrow() ||
                                elimination.getFirstOuterSlot() + (int) elimination.outer.size() > LARGEST_INDEX - 8))
            return false;
    }
    std::unique_ptr<Elimination> joined;
    if (numPieceJoints > 0)
        joined.reset(new Elimination(cluster.jointLevels, cluster.numJointLevels, cluster.jointColumns, 0, {}));
    const int numJointEntries = joined == nullptr ? 0 : joined->getNumEntries();
    if (joined != nullptr && (!joined->isNarrow() || numPieceJoints + numJointEntries > LARGEST_INDEX))
        return false;

    // What the joints' matrix is the sum of: each piece sends its diagonal entries, then those between its joints.
    vector<vector<int>> sources(numPieceJoints + numJointEntries);
    vector<Layout> layouts(parts.size());
    int numContributions = 0;
    for (size_t p = 0; p < parts.size(); p++) {
        const vector<int>& borders = cluster.pieces[p].borders;
        const int numInner = parts[p].elimination->size;
        layouts[p].firstContribution = numContributions;
        for (int joint : borders)
            sources[joint].push_back(numContributions++);
        for (const auto& entry : parts[p].elimination->outer)
            sources[joined->findSlot(borders[entry.first - numInner], borders[entry.second - numInner])].push_back(
                numContributions++);
    }
    if (numContributions > LARGEST_INDEX)
        return false;

    // The tables.
    for (size_t p = 0; p < parts.size(); p++) {
        const Part& part = parts[p];
        const Elimination& elimination = *part.elimination;
        Layout& layout = layouts[p];
        const int numInner = elimination.size, numRows = elimination.getNumRows();
        const int numBorders = elimination.numOuter, numParticles = (int) cluster.pieces[p].particles.size();
        layout.numInner = numInner;
        layout.particles = cluster.pieces[p].particles;
        layout.constraints = part.constraints;
        Writer writer(form.areRecords);
        writer.set(NumLevels, elimination.numLevels);
        if (form.areRecords) {
            vector<int> more;
            int numWide;
            const vector<int> starts = elimination.writeRecords(writer, limits.narrow, more, numWide);
            vector<int> jointMore, jointStarts;
            int numJointWide = 0;
            if (joined != nullptr)
                jointStarts = joined->writeRecords(writer, 0, jointMore, numJointWide);
            writer.set(NumWide, numWide);
            writer.set(LevelStarts, writer.addWords(starts));
            writer.set(More, writer.addIndices(more));
            if (joined != nullptr) {
                writer.set(NumJointLevels, joined->numLevels);
                writer.set(NumJointEntries, numJointEntries);
                writer.set(JointLevelStarts, writer.addWords(jointStarts));
                writer.set(JointMore, writer.addIndices(jointMore));
                vector<int> borders, sourceStart(1, 0), sourceList;
                for (int joint : cluster.pieces[p].borders) {
                    const int side = pieceOf[particlesOf[cluster.joints[joint]][0]] == (int) p ? 0 : 1;
                    borders.push_back(2 * joint + side);
                }
                for (const vector<int>& list : sources) {
                    sourceList.insert(sourceList.end(), list.begin(), list.end());
                    sourceStart.push_back((int) sourceList.size());
                }
                writer.set(Borders, writer.addWords(borders));
                writer.set(SourceStart, writer.addIndices(sourceStart));
                writer.set(Sources, writer.addIndices(sourceList));
                writer.set(NumBorderEntries, (int) elimination.outer.size());
                writer.set(FirstContribution, layout.firstContribution);
                writer.set(FirstBorderEntry, elimination.getFirstOuterSlot());
            }
        }
        else {
            vector<int> entryRow, entryColumn, rowStart(1, 0), rowEntry, rowColumn;
            vector<vector<int>> entriesOf(numInner);
            for (int column = 0; column < numInner; column++)
                for (const int* row = elimination.columns.begin(column); row != elimination.columns.end(column);
                     ++row) {
                    entriesOf[*row].push_back((int) entryRow.size());
                    entryRow.push_back(*row);
                    entryColumn.push_back(column);
                }
            for (const vector<int>& list : entriesOf) {
                for (int entry : list) {
                    rowEntry.push_back(numRows + entry);
                    rowColumn.push_back(entryColumn[entry]);
                }
                rowStart.push_back((int) rowEntry.size());
            }
            writer.set(LevelStarts, writer.addWords(elimination.levels));
            writer.set(ColumnStart,
                       writer.addWords({elimination.columns.start.begin(), elimination.columns.start.end()}));
            writer.set(EntryRow, writer.addWords(entryRow));
            writer.set(EntryColumn, writer.addWords(entryColumn));
            writer.set(RowStart, writer.addWords(rowStart));
            writer.set(RowEntry, writer.addWords(rowEntry));
            writer.set(RowColumn, writer.addWords(rowColumn));
        }
        vector<int> couplings;
        for (const auto& coupling : part.couplings) {
            const int a = coupling.first.first, b = coupling.first.second;
            couplings.insert(couplings.end(), {elimination.findSlot(a, b), a, b, coupling.second[0],
                                               coupling.second.size() > 1 ? coupling.second[1] : -1});
        }
        writer.set(NumCouplings, (int) part.couplings.size());
        writer.set(Couplings, writer.addWords(couplings));
        vector<int> ends;
        for (int k : layout.constraints)
            for (int i : particlesOf[k])
                ends.push_back(pieceOf[i] == (int) p ? placeOf[i] : -1);
        writer.set(Ends, writer.addWords(ends));
        vector<int> incidenceStart(1, 0), incidence;
        for (int i = 0; i < numParticles; i++) {
            for (int row : part.rowsOf[i])
                incidence.push_back(2 * row + (particlesOf[layout.constraints[row]][0] != layout.particles[i]));
            incidenceStart.push_back((int) incidence.size());
        }
        writer.set(IncidenceStart, writer.addIndices(incidenceStart));
        writer.set(IncidenceList, writer.addIndices(incidence));
        layout.tables = writer.finish();
        if (form.areRecords && 4 * layout.tables.size() > LARGEST_TABLE)
            return false;
        const size_t numValues =
            (size_t) elimination.getFirstOuterSlot() + elimination.outer.size() + (size_t) numBorders * numPieceJoints;
        layout.numKept = roundUp(numValues + 8, 4);
        layout.factorSize = roundUp((size_t) layout.numKept + 4 * numRows + numParticles + SPLIT * numBorders +
                                        2 * numPieceJoints + numJointEntries + 8,
                                    4);
        layout.workSize = roundUp((size_t) 5 * numInner + numRows + 7 * numParticles + 7 * numPieceJoints, 4);
        numLevels = std::max(numLevels, elimination.numLevels);
        numEntries = std::max(numEntries, (size_t) elimination.getNumEntries());
    }
    numJoints = std::max(numJoints, numPieceJoints);
    if (joined != nullptr)
        numJointLevels = std::max(numJointLevels, joined->numLevels);

    // And for each cluster of the kind.
    vector<int> firstTable;
    for (const Layout& layout : layouts) {
        firstTable.push_back((int) (tables.size() / 4));
        tables.insert(tables.end(), layout.tables.begin(), layout.tables.end());
    }
    for (int c = 0; c < kind.getNumClusters(); c++) {
        auto lengthOf = [&](int k) { return given.distances[kind.getConstraint(c, k)].length; };
        const int firstJoint = (int) joints.size(), channel = (int) numWords;
        numWords += (size_t) (limits.mixedSize / 4) * (16 * numPieceJoints + numContributions);
        for (int place = 0; place < numPieceJoints; place++) {
            const int k = cluster.joints[place];
            joints.push_back({kind.getParticle(c, particlesOf[k][0]), kind.getParticle(c, particlesOf[k][1]),
                              numConstraints + k, 0});
            jointLengths.push_back(lengthOf(k));
        }
        for (size_t p = 0; p < layouts.size(); p++) {
            const Layout& layout = layouts[p];
            const int tableSize = (int) layout.tables.size() / 4, numRows = (int) layout.constraints.size();
            const int workWords = (layout.workSize * limits.mixedSize + 15) / 16;
            const int factorWords = (layout.factorSize * limits.realSize + 15) / 16;
            Piece piece = {firstTable[p],
                           tableSize,
                           (int) rows.size(),
                           layout.numInner,
                           numRows - layout.numInner,
                           (int) atoms.size(),
                           (int) layout.particles.size(),
                           firstJoint,
                           numPieceJoints,
                           (int) numFactors,
                           layout.numKept,
                           (int) numWork,
                           channel,
                           tableSize,
                           tableSize + workWords,
                           p == 0 ? (int) layouts.size() : 0};
            localSize = std::max({localSize, tableSize + workWords + factorWords, tableSize + limits.numThreads + 1});
            numFactors += layout.factorSize;
            numWork += layout.workSize;
            for (int k : layout.constraints) {
                const int i = particlesOf[k][0], j = particlesOf[k][1];
                const bool isFirst = pieceOf[i] == (int) p, isSecond = pieceOf[j] == (int) p;
                const int number = numConstraints + k;
                rows.push_back({kind.getParticle(c, i), kind.getParticle(c, j), isFirst ? number : number | INT32_MIN,
                                (isFirst ? 1 : 0) + (isSecond ? 2 : 0)});
                rowLengths.push_back(lengthOf(k));
            }
            for (int i : layout.particles)
                atoms.push_back(kind.getParticle(c, i));
            pieces.push_back(piece);
        }
        for (int k = 0; k < count; k++)
            constraints.push_back(kind.getConstraint(c, k));
        numConstraints += count;
    }
    return true;
}
