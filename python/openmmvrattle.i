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
#include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"

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

ConstraintParts getConstraintParts(const OpenMMVRattle::ConstrainedIntegrator* integrator, int index) {
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
%define RELEASES_GIL(class, method)
%exception OpenMMVRattle::class::method {
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
RELEASES_GIL(ConstrainedIntegrator, getExpressionConstraintMultiplier)
RELEASES_GIL(ConstrainedIntegrator, getMultipliers)
RELEASES_GIL(ConstrainedIntegrator, setVelocitiesToTemperature)
RELEASES_GIL(ConstrainedIntegrator, step)
RELEASES_GIL(VariableStepRattleIntegrator, calibrate)
RELEASES_GIL(VariableStepRattleIntegrator, getMonitorValue)
RELEASES_GIL(VariableStepRattleIntegrator, reverse)
RELEASES_GIL(VariableStepRattleIntegrator, stepTo)
RELEASES_GIL(VariableStepRattleLangevinIntegrator, getMonitorValue)

// Default arguments would turn into *args; the defaults stand in integrators.py.
%feature("compactdefaultargs");
%feature("autodoc", "0");

// Values that C++ returns by reference are returned as a list.
%apply int& OUTPUT { OpenMMVRattle::VariableStepRattleIntegrator::MonitorKind& kind };
%apply double& OUTPUT { double& weight, double& power };

// Those of OpenMM's own class, which in Python take a set as well, call ours.
%ignore OpenMMVRattle::ConstrainedIntegrator::getIntegrationForceGroups;
%ignore OpenMMVRattle::ConstrainedIntegrator::setIntegrationForceGroups;
%ignore OpenMMVRattle::ConstrainedIntegrator::getExpressionConstraintParameters;
// Copies are made in Python.
%ignore OpenMMVRattle::VariableStepRattleIntegrator::VariableStepRattleIntegrator(const VariableStepRattleIntegrator&);
%ignore OpenMMVRattle::VariableStepRattleLangevinIntegrator::VariableStepRattleLangevinIntegrator(
    const VariableStepRattleLangevinIntegrator&);

%nodefaultctor OpenMMVRattle::ConstrainedIntegrator;
%include "openmmvrattle/ConstrainedIntegrator.h"
%include "openmmvrattle/VariableStepRattleIntegrator.h"
%include "openmmvrattle/VariableStepRattleLangevinIntegrator.h"

%extend OpenMMVRattle::ConstrainedIntegrator {
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

// To find out what OpenMM has returned as a bare Integrator.
%define CASTS(class)
%extend OpenMMVRattle::class {
    static bool _isinstance(const OpenMM::Integrator* integrator) {
        return dynamic_cast<const OpenMMVRattle::class*>(integrator) != NULL;
    }
    static OpenMMVRattle::class* _cast(OpenMM::Integrator* integrator) {
        return dynamic_cast<OpenMMVRattle::class*>(integrator);
    }
}
%enddef
CASTS(ConstrainedIntegrator)
CASTS(VariableStepRattleIntegrator)
CASTS(VariableStepRattleLangevinIntegrator)
