// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// The tests of `tests` on a GPU platform. The program's arguments are its name, our library for it and a precision; then perhaps
// the number of one test, or the word `count`, to print how many there are.

#include "ReferenceVRattleKernelFactory.h"
#include "TestSupport.h"
#include "openmm/Platform.h"
#include <cctype>

namespace OpenMMVRattle {

inline std::string& testPlatformName() {
    static std::string name;
    return name;
}

inline OpenMM::Platform& getTestPlatform() {
    return OpenMM::Platform::getPlatform(testPlatformName());
}

/** A message, whose numbers may differ by rounding. */
inline std::string withoutNumbers(const std::string& text) {
    std::string result;
    for (char c : text)
        if (!std::isdigit(c) && c != '.' && c != '-' && c != '+' && c != 'e')
            result += c;
    return result;
}

inline int runOnPlatform(const TestList& tests, int argc, char** argv) {
    if (argc > 4 && std::string(argv[4]) == "count") {
        std::cout << tests.size() << std::endl;
        return 0;
    }
    if (argc < 4) {
        std::cerr << argv[0] << " <platform> <library> <precision> [<test> | count]" << std::endl;
        return 2;
    }
    testPlatformName() = argv[1];
    OpenMM::Platform::loadPluginsFromDirectory(OpenMM::Platform::getDefaultPluginsDirectory());
    registerVRattleReferenceKernelFactories(); // to compare with
    OpenMM::Platform::loadPluginLibrary(argv[2]);
    getTestPlatform().setPropertyDefaultValue("Precision", argv[3]);
    TestList chosen = tests;
    if (argc > 4)
        chosen = {tests.at(std::stoi(argv[4]))};
    return runTests(chosen);
}

} // namespace OpenMMVRattle
