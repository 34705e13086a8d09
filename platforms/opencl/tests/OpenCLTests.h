// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The tests of `tests` on the platform OpenCL; the program's arguments are our library for it and a precision.

#include "TestSupport.h"
#include "openmm/Platform.h"

namespace OpenMMVRattle {

inline OpenMM::Platform& getTestPlatform() {
    return OpenMM::Platform::getPlatform("OpenCL");
}

inline int runOnPlatform(const TestList& tests, int argc, char** argv) {
    if (argc < 3) {
        std::cerr << argv[0] << " <library> <precision> [<test>]" << std::endl;
        return 2;
    }
    OpenMM::Platform::loadPluginsFromDirectory(OpenMM::Platform::getDefaultPluginsDirectory());
    OpenMM::Platform::loadPluginLibrary(argv[1]);
    getTestPlatform().setPropertyDefaultValue("Precision", argv[2]);
    TestList chosen = tests;
    if (argc > 3)
        chosen = {tests.at(std::stoi(argv[3]))};
    return runTests(chosen);
}

} // namespace OpenMMVRattle
