// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_FORCESQUARES_H_
#define OPENMMVRATTLE_FORCESQUARES_H_

#include "constraints/ConstraintSolver.h"
#include "constraints/StepFailure.h"
#include "constraints/Sum.h"
#include "openmm/Vec3.h"
#include <cmath>
#include <vector>

namespace OpenMMVRattle {

/**
 * The sum of |F|^2 over the particles and, if that is wanted, of |F|^2/m, which is found along with a pass over these that somebody
 * makes anyway, or else in one of its own. The force on a particle that does not move is of no interest, even if it is not a number.
 */
class ForceSquares : public ConstraintSolver::Observer {
public:
    explicit ForceSquares(const ConstraintSolver& solver) :
            solver(solver), system(solver.getSystem()), isOverMassWanted(false), sum(0), sumOverMass(0),
            blockSums(system.getBlocks().size() - 1), blockSumsOverMass(blockSums) {
    }
    void setOverMassWanted(bool isWanted) {
        isOverMassWanted = isWanted;
    }
    /** These are the forces to be seen in the pass that comes. */
    void observe(const std::vector<OpenMM::Vec3>& newForces) {
        forces = &newForces;
    }
    void seeParticles(int block) override {
        if (forces == nullptr)
            return;
        const int first = system.getBlocks()[block].particle, end = system.getBlocks()[block + 1].particle;
        const double* inverseMasses = system.getInverseMasses().data() + first;
        auto square = [&](int i) { return squareOf((*forces)[first + i], first + i); };
        blockSums[block] = sumOf(end - first, square);
        if (isOverMassWanted)
            blockSumsOverMass[block] = sumOf(end - first, [&](int i) { return square(i) * inverseMasses[i]; });
    }
    /**
     * Find the sums, of forces that have just been observed or of others.
     *
     * @throws StepFailure    if one of them is not finite
     */
    void find(const std::vector<OpenMM::Vec3>& newForces) {
        const int numBlocks = (int) blockSums.size();
        if (forces != &newForces) {
            forces = &newForces;
            for (int block = 0; block < numBlocks; block++)
                seeParticles(block);
        }
        forces = nullptr;
        sum = sumOf(numBlocks, [&](int k) { return blockSums[k]; });
        sumOverMass = sumOf(numBlocks, [&](int k) { return blockSumsOverMass[k]; });
        if (!std::isfinite(sum))
            throw solver.explainForces(newForces);
    }
    double getSum() const {
        return sum;
    }
    double getSumOverMass() const {
        return sumOverMass;
    }
    /** |F|^2 of a particle. */
    double squareOf(const OpenMM::Vec3& force, int particle) const {
        return system.getInverseMasses()[particle] > 0 ? force.dot(force) : 0.0;
    }

private:
    const ConstraintSolver& solver;
    const ConstraintSystem& system;
    const std::vector<OpenMM::Vec3>* forces = nullptr; // that are to be seen
    bool isOverMassWanted;
    double sum, sumOverMass;
    std::vector<double> blockSums, blockSumsOverMass;
};

} // namespace OpenMMVRattle

#endif // OPENMMVRATTLE_FORCESQUARES_H_
