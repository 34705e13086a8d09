// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#ifndef OPENMMVRATTLE_WINDOWS_EXPORT_H_
#define OPENMMVRATTLE_WINDOWS_EXPORT_H_

/**
 * OPENMMVRATTLE_EXPORT marks what the library libOpenMMVRattle shows to others. Only Windows needs it; there the
 * library itself is compiled with OPENMMVRATTLE_BUILDING_SHARED_LIBRARY.
 */
#ifdef _MSC_VER
    #if defined(OPENMMVRATTLE_BUILDING_SHARED_LIBRARY)
        #define OPENMMVRATTLE_EXPORT __declspec(dllexport)
    #else
        #define OPENMMVRATTLE_EXPORT __declspec(dllimport)
    #endif
#else
    #define OPENMMVRATTLE_EXPORT
#endif

#endif // OPENMMVRATTLE_WINDOWS_EXPORT_H_
