// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// What Python can call of the C++ interface, with plain numbers. Units, documentation and all else that users see are in
// openmmvrattle/integrators.py.

%module(package="openmmvrattle") vrattle

%include "std_map.i"
%include "std_string.i"
%include "std_vector.i"
%include "typemaps.i"

%import(module="openmm") "swig/OpenMMSwigHeaders.i"

// Without a name SWIG wraps no class for it, but it turns returned vectors into tuples, and takes dicts for maps.
%template() std::vector<double>;
%template() std::vector<int>;
%template() std::map<std::string, double>;

%{
#include "OpenMM.h"
// SWIG writes out the conversions between all classes that OpenMM's interface file declares.
#include "OpenMMAmoeba.h"
#include "OpenMMDrude.h"
#include "openmm/RPMDIntegrator.h"
#include "openmm/RPMDMonteCarloBarostat.h"
#include "openmmvrattle/VariableStepRattleIntegrator.h"

namespace {

/** Releases Python's global lock while it lives, so that other Python threads, and forces written in Python, can run. */
class ReleasedGIL {
public:
    ReleasedGIL() : state(PyEval_SaveThread()) {
    }
    ~ReleasedGIL() {
        PyEval_RestoreThread(state);
    }
    ReleasedGIL(const ReleasedGIL&) = delete;
    ReleasedGIL& operator=(const ReleasedGIL&) = delete;

private:
    PyThreadState* state;
};

/** Turns a C++ exception into a Python one, of the class that OpenMM itself uses. */
void setOpenMMException(const char* message) {
    PyObject* module = PyImport_ImportModule("openmm");
    PyObject* type = (module == NULL ? NULL : PyObject_GetAttrString(module, "OpenMMException"));
    if (type != NULL)
        PyErr_SetString(type, message);
    Py_XDECREF(type);
    Py_XDECREF(module);
}

/** What a constraint was added with. */
struct ConstraintParts {
    std::string expression;
    std::vector<int> particles;
    std::map<std::string, double> parameters;
};

ConstraintParts getConstraintParts(const OpenMMVRattle::VariableStepRattleIntegrator* integrator, int index) {
    ConstraintParts parts;
    integrator->getExpressionConstraintParameters(index, parts.expression, parts.particles, parts.parameters);
    return parts;
}

} // namespace
%}

%exception {
    try {
        $action
    }
    catch (const std::exception& e) {
        setOpenMMException(e.what());
        SWIG_fail;
    }
}

// For methods that may compute forces, which can take long or call Python code.
%define RELEASES_GIL(method)
%exception OpenMMVRattle::VariableStepRattleIntegrator::method {
    try {
        ReleasedGIL released;
        $action
    }
    catch (const std::exception& e) {
        setOpenMMException(e.what());
        SWIG_fail;
    }
}
%enddef
RELEASES_GIL(calibrate)
RELEASES_GIL(getExpressionConstraintMultiplier)
RELEASES_GIL(getMonitorValue)
RELEASES_GIL(getMultipliers)
RELEASES_GIL(reverse)
RELEASES_GIL(setVelocitiesToTemperature)
RELEASES_GIL(step)
RELEASES_GIL(stepTo)

// Default arguments would turn into *args; the defaults stand in integrators.py.
%feature("compactdefaultargs");
%feature("autodoc", "0");

// Values that C++ returns by reference are returned as a list.
%apply int& OUTPUT { OpenMMVRattle::VariableStepRattleIntegrator::MonitorKind& kind };
%apply double& OUTPUT { double& weight, double& power };

// Those of OpenMM's own class, which in Python take a set as well, call ours.
%ignore OpenMMVRattle::VariableStepRattleIntegrator::getIntegrationForceGroups;
%ignore OpenMMVRattle::VariableStepRattleIntegrator::setIntegrationForceGroups;
// Copies are made in Python.
%ignore OpenMMVRattle::VariableStepRattleIntegrator::VariableStepRattleIntegrator(const VariableStepRattleIntegrator&);
%ignore OpenMMVRattle::VariableStepRattleIntegrator::getExpressionConstraintParameters;

#define OPENMMVRATTLE_EXPORT
%include "openmmvrattle/VariableStepRattleIntegrator.h"

%extend OpenMMVRattle::VariableStepRattleIntegrator {
    static bool _isinstance(const OpenMM::Integrator* integrator) {
        return dynamic_cast<const OpenMMVRattle::VariableStepRattleIntegrator*>(integrator) != NULL;
    }
    static OpenMMVRattle::VariableStepRattleIntegrator* _cast(OpenMM::Integrator* integrator) {
        return dynamic_cast<OpenMMVRattle::VariableStepRattleIntegrator*>(integrator);
    }
    std::string _getExpression(int index) const {
        return getConstraintParts($self, index).expression;
    }
    std::vector<int> _getExpressionParticles(int index) const {
        return getConstraintParts($self, index).particles;
    }
    std::map<std::string, double> _getExpressionParameters(int index) const {
        return getConstraintParts($self, index).parameters;
    }
}
