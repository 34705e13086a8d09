// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_SHAREDWORK_H_
#define OPENMMVRATTLE_SHAREDWORK_H_

#include "constraints/ClusterBatch.h"
#include "constraints/ConstraintMatrix.h"
#include "constraints/ConstraintSystem.h"
#include "constraints/Sum.h"
#include "constraints/ThreadChoice.h"
#include <algorithm>
#include <chrono>
#include <exception>
#include <functional>
#include <limits>
#include <utility>
#include <vector>

namespace OpenMMVRattle {

/**
 * Goes through all clusters and free particles of a system with some tasks, on several threads where that is faster. What a task does
 * with one cluster, piece or block never depends on the number of threads, so that results do not either, to the last bit. A task
 * may throw: when all threads have ended, the exception of the first of them goes on to the caller.
 */
class SharedWork {
public:
    /** Runs a task on several threads at once, as task(thread), and returns when all have ended. */
    typedef std::function<void(const std::function<void(int)>&)> Parallel;

    /** What tasks find: the largest error, the smallest pivot (a NaN counts), and the like. */
    struct Result {
        double error = 0, pieceError = 0, pivot = std::numeric_limits<double>::infinity();
        int iterations = 0, batchIterations = 0, failed = ConstraintMatrix::REGULAR;
        std::exception_ptr exception; // that ended a thread's share
        void addError(double other) {
            error = largerOf(error, other);
        }
        void addPieceError(double other) {
            pieceError = largerOf(pieceError, other);
        }
        void addPivot(double other) {
            pivot = smallerOf(pivot, other);
        }
        void addFailed(int other) {
            failed = std::max(failed, other);
        }
        void addIterations(int other) {
            iterations = std::max(iterations, other);
        }
        void addBatchIterations(int other) { // of several trials, where they are counted apart
            batchIterations = std::max(batchIterations, other);
        }
        void merge(const Result& other) {
            addError(other.error);
            addPieceError(other.pieceError);
            addPivot(other.pivot);
            addFailed(other.failed);
            addIterations(other.iterations);
            addBatchIterations(other.batchIterations);
        }
    };

    explicit SharedWork(const ConstraintSystem& system) : system(system), seconds(0) {
    }
    void setParallel(const Parallel& newParallel, int numThreads) {
        parallel = numThreads > 1 ? newParallel : Parallel();
        results.resize(numThreads);
    }
    /** A step begins; how its work is shared stays the same until it ends. */
    void beginStep() {
        seconds = 0;
    }
    void endStep() {
        choice.add(seconds);
    }

    /**
     * Go through all particles block by block, calling a task for what each batch has there, batchTask(batch, first cluster, end,
     * result), one for particles without constraints, freeTask(particle), and at the end of each block blockTask(block); then through
     * the parts of whole clusters, partTask(part, result), and the pieces of those that are cut, pieceTask(piece, result). A cluster
     * is worked on in the same lane of a pack whatever the number of threads, since blocks begin at whole packs.
     */
    template <class BlockTask, class BatchTask, class FreeTask, class PartTask, class PieceTask>
    Result run(const BlockTask& blockTask, const BatchTask& batchTask, const FreeTask& freeTask,
               const PartTask& partTask, const PieceTask& pieceTask) {
        const auto& batches = system.getBatches();
        const auto& blocks = system.getBlocks();
        const std::vector<int>& freeParticles = system.getFreeParticles();
        return runOnThreads([&](int thread, int numThreads, Result& result) {
            forShare(blocks.size() - 1, thread, numThreads, [&](size_t b) {
                for (size_t k = 0; k < batches.size(); k++) {
                    const int first = blocks[b].clusters[k], end = blocks[b + 1].clusters[k];
                    if (first < end)
                        batchTask(*batches[k], first, end, result);
                }
                for (int k = blocks[b].freeParticle; k < blocks[b + 1].freeParticle; k++)
                    freeTask(freeParticles[k]);
                blockTask((int) b);
            });
            forShare(system.getGeneralParts().size(), thread, numThreads,
                     [&](size_t k) { partTask(system.getGeneralParts()[k], result); });
            forShare(system.getPieces().size(), thread, numThreads,
                     [&](size_t k) { pieceTask(system.getPieces()[k], result); });
        });
    }
    /** Run a task on the pieces of cut clusters alone: task(piece, result). */
    template <class PieceTask> Result runOnPieces(const PieceTask& task) {
        if (system.getPieces().empty())
            return Result();
        return runOnThreads([&](int thread, int numThreads, Result& result) {
            forShare(system.getPieces().size(), thread, numThreads,
                     [&](size_t k) { task(system.getPieces()[k], result); });
        });
    }
    /** Go through 0, ..., count - 1 in ranges of RANGE_SIZE, the last of which may be shorter: task(number of the range, first, end). */
    static constexpr int RANGE_SIZE = 1024;
    static int getNumRanges(int count) {
        return (count + RANGE_SIZE - 1) / RANGE_SIZE;
    }
    template <class Task> void runOnRanges(int count, const Task& task) {
        runOnThreads([&](int thread, int numThreads, Result&) {
            forShare(getNumRanges(count), thread, numThreads, [&](size_t range) {
                const int first = (int) range * RANGE_SIZE;
                task((int) range, first, std::min(count, first + RANGE_SIZE));
            });
        });
    }
    /** Run a task on each cut cluster, for its joints, when that on the pieces has ended: task(cluster). */
    template <class JointTask> void runOnJoints(const JointTask& task) const {
        for (const ConstraintSystem::CutCluster& cluster : system.getCutClusters())
            task(cluster);
    }

private:
    // Threads may share the work from this number of constraints and particles together on. A pass costs 10 to 25 ns a constraint,
    // some 3 ns a free particle, and a call of the thread pool 5 us at the least.
    static constexpr int MIN_PARALLEL = 4000;

    template <class Task> static void forShare(size_t count, int thread, int numThreads, const Task& task) {
        const size_t end = count * (thread + 1) / numThreads;
        for (size_t k = count * thread / numThreads; k < end; k++)
            task(k);
    }
    // Call share(thread, number of threads, result) on each thread, or once if that is faster.
    template <class Share> Result runOnThreads(const Share& share) {
        Result result;
        if (!parallel || system.getNumConstraints() + system.getNumParticles() < MIN_PARALLEL) {
            share(0, 1, result);
            return result;
        }
        typedef std::chrono::steady_clock Clock;
        const Clock::time_point start = Clock::now();
        if (choice.isParallel()) {
            const int numThreads = (int) results.size();
            auto runShare = [&](int thread) {
                Result own; // on the thread's own stack, away from those of others
                try {
                    share(thread, numThreads, own);
                }
                catch (...) { // which must leave neither a thread of the pool nor this one before the others have ended
                    own.exception = std::current_exception();
                }
                results[thread] = own;
            };
            parallel(std::ref(runShare)); // which a std::function holds without allocating memory
            for (Result& each : results) {
                if (each.exception != nullptr)
                    std::rethrow_exception(std::exchange(each.exception, nullptr));
                result.merge(each);
            }
        }
        else
            share(0, 1, result);
        seconds += std::chrono::duration<double>(Clock::now() - start).count();
        return result;
    }

    const ConstraintSystem& system;
    Parallel parallel; // empty: one thread
    std::vector<Result> results;
    ThreadChoice choice;
    double seconds; // spent in this step
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_SHAREDWORK_H_
