// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_LARGECLUSTERS_H_
#define OPENMMVRATTLE_LARGECLUSTERS_H_

#include "constraints/ClusterLayout.h"
#include <cstddef>
#include <vector>

namespace OpenMMVRattle {

/**
 * The clusters of more constraints than one thread can have, for kernels/large.cc: cut into pieces, each for a work group, with the
 * order in which its constraints are eliminated as tables. All is worked out once, for each constraint graph.
 *
 * The constraints of a piece are its rows, in the order of elimination: first those within it, then those to other pieces, the
 * joints. All joints of a cluster are solved for by each of its groups, once all pieces have been eliminated.
 */
class LargeClusters {
public:
    /** What a device has to offer. */
    struct Limits {
        int numThreads;     // for a piece
        int localMemory;    // bytes for a piece
        int numResident; // work groups that are sure to run at the same time, and may wait for each other; 0 if none may
        int narrow; // threads that are in step without a barrier; 0 if it is not known
        int mixedSize, realSize;
        int numGroups; // that a launch can have
        int pieceSize; // constraints; more if the pieces were too many to be resident
    };
    /** How the pieces are worked on. */
    struct Form {
        bool areRecords; // each level of an elimination is a list of records; else rows and columns of L
        bool isInLocalMemory;
        bool hasJoints;
        bool isStaged; // each stage is a launch of its own, since groups cannot wait for each other
        bool isFused; // the pieces are work groups of the launches of the small clusters
    };
    /** Sixteen numbers for each piece, as kernels/large.cc has them. The first piece of a cluster knows how many there are. */
    struct Piece {
        int firstTable, tableSize, firstRow, numInner;
        int numBorders, firstAtom, numAtoms, firstJoint;
        int numJoints, firstKept, numKept, firstWork;
        int channel, localWork, localFactor;
        int numPieces; // of the cluster, in the first of them; else 0
    };
    struct Row {
        int atom1, atom2;
        int number; // of the constraint; less than zero where another piece counts it
        int ends; // 1 if the first particle is the piece's own, + 2 if the second is
    };

    LargeClusters(const ClusterLayout& layout, const Limits& limits);
    /**
     * The kinds of such clusters, those with most constraints first. So their constraints are numbered: kind by kind and cluster by cluster,
     * by their places in it.
     */
    static std::vector<const ClusterKind*> findKinds(const ClusterLayout& layout);
    bool isEmpty() const {
        return pieces.empty();
    }
    const Form& getForm() const {
        return form;
    }
    const std::vector<Piece>& getPieces() const {
        return pieces;
    }
    const std::vector<unsigned>& getTables() const {
        return tables;
    }
    const std::vector<Row>& getRows() const {
        return rows;
    }
    const std::vector<double>& getRowLengths() const {
        return rowLengths;
    }
    const std::vector<int>& getAtoms() const {
        return atoms;
    }
    const std::vector<Row>& getJoints() const {
        return joints;
    }
    const std::vector<double>& getJointLengths() const {
        return jointLengths;
    }
    int getNumConstraints() const {
        return numConstraints;
    }
    /** Of each number of a constraint: as it was given. */
    const std::vector<int>& getConstraints() const {
        return constraints;
    }
    /** Numbers in global memory: of the factors, of what else a piece has, and words of 64 bits for what is sent. */
    size_t getNumFactors() const {
        return numFactors;
    }
    size_t getNumWork() const {
        return numWork;
    }
    size_t getNumWords() const {
        return numWords;
    }
    /** Words of 16 bytes of local memory. */
    int getLocalSize() const {
        return localSize;
    }
    int getNumThreads() const {
        return numThreads;
    }
    /** The threads of which a few may be in step without a barrier, or 0. */
    int getNarrow() const {
        return narrow;
    }
    /** What there is of local memory for a work group, in bytes. */
    int getLocalMemory() const {
        return localMemory;
    }
    /** The largest numbers among the pieces: levels, entries of the factor below the diagonal, joints of a cluster. */
    int getNumLevels() const {
        return numLevels;
    }
    size_t getNumEntries() const {
        return numEntries;
    }
    int getNumJoints() const {
        return numJoints;
    }
    int getNumJointLevels() const {
        return numJointLevels;
    }

private:
    struct Layout;
    struct Elimination;
    bool addKind(const ClusterLayout& given, const ClusterKind& kind, const Limits& limits, int pieceSize);
    void build(const ClusterLayout& layout, const Limits& limits, int pieceSize);
    bool isTooLarge() const;
    void clear();
    Form form;
    std::vector<Piece> pieces;
    std::vector<unsigned> tables;
    std::vector<Row> rows, joints;
    std::vector<double> rowLengths, jointLengths;
    std::vector<int> atoms, constraints;
    int numConstraints, numThreads, narrow, localMemory, localSize, numLevels, numJoints, numJointLevels;
    size_t numFactors, numWork, numWords, numEntries;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_LARGECLUSTERS_H_
