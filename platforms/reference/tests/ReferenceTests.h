// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The platforms that the Reference kernels serve; the program's argument says which one is tested.

#include "ReferenceVRattleKernelFactory.h"
#include "TestSupport.h"
#include "openmm/Platform.h"

namespace OpenMMVRattle {

inline std::string& testPlatformName() {
    static std::string name = "Reference";
    return name;
}

inline OpenMM::Platform& getTestPlatform() {
    return OpenMM::Platform::getPlatform(testPlatformName());
}

inline int runOnPlatform(const TestList& tests, int argc, char** argv) {
    if (argc > 1)
        testPlatformName() = argv[1];
    OpenMM::Platform::loadPluginsFromDirectory(OpenMM::Platform::getDefaultPluginsDirectory());
    registerVRattleReferenceKernelFactories();
    return runTests(tests);
}

} // namespace OpenMMVRattle
