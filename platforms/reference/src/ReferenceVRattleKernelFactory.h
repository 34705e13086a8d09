// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_REFERENCEVRATTLEKERNELFACTORY_H_
#define OPENMMVRATTLE_REFERENCEVRATTLEKERNELFACTORY_H_

/** Register the kernels without loading the plugin library by hand (for programs that link with it). */
extern "C" void registerVRattleReferenceKernelFactories();

#endif // OPENMMVRATTLE_REFERENCEVRATTLEKERNELFACTORY_H_
