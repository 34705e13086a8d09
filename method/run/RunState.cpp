// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/RunState.h"
#include "openmm/OpenMMException.h"
#include <algorithm>
#include <istream>
#include <ostream>
#include <string>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using OpenMM::SerializationNode;
using OpenMM::Vec3;
using std::string;
using std::vector;

namespace {

[[noreturn]] void throwDamaged() {
    throw OpenMMException("OpenMM-VRATTLE: the saved state of the run is damaged, its parts do not fit "
                          "together");
}

typedef std::map<string, vector<double>> Lists;

// Writes into a stream in binary form, without names, or reads from one.
class BinaryForm {
public:
    BinaryForm(std::ostream* to, std::istream* from) : to(to), from(from) {
    }
    template <class T> void add(const char*, T& value) {
        char* bytes = reinterpret_cast<char*>(&value);
        if (to != nullptr)
            to->write(bytes, sizeof(T));
        else if (!from->read(bytes, sizeof(T)))
            throwDamaged();
    }
    template <class T> void add(const char* name, vector<T>& values) {
        long long size = (long long) values.size();
        add(name, size);
        if (to == nullptr)
            values.clear();
        for (long long i = 0; i < size; i++) {
            if (to == nullptr) // grows no further than the stream goes, whatever the size says
                values.emplace_back();
            add(name, values[i]);
        }
    }
    void add(const char* name, Lists& lists) {
        const vector<Lists::value_type> given(lists.begin(), lists.end());
        long long size = (long long) given.size();
        add(name, size);
        for (long long i = 0; i < size; i++) {
            vector<char> key;
            if (to != nullptr)
                key.assign(given[i].first.begin(), given[i].first.end());
            add(name, key);
            add(name, lists[string(key.begin(), key.end())]);
        }
    }
    void addIfAny(const char* name, vector<double>& values) {
        add(name, values);
    }

private:
    std::ostream* to; // or null
    std::istream* from;
};

// Writes into a node of XML, or reads from one.
class NodeForm {
public:
    NodeForm(SerializationNode* to, const SerializationNode* from) : to(to), from(from) {
    }
    void add(const char* name, bool& value) {
        if (to != nullptr)
            to->setBoolProperty(name, value);
        else
            value = from->getBoolProperty(name);
    }
    void add(const char* name, double& value) {
        if (to != nullptr)
            to->setDoubleProperty(name, value);
        else
            value = from->getDoubleProperty(name);
    }
    void add(const char* name, unsigned long long& value) {
        if (to != nullptr)
            to->setLongProperty(name, (long long) value);
        else
            value = (unsigned long long) from->getLongProperty(name);
    }
    void add(const char*, Vec3& vector) {
        add("x", vector[0]);
        add("y", vector[1]);
        add("z", vector[2]);
    }
    void add(const string& name, vector<double>& values) {
        addList(name, "Value", "v", values);
    }
    void add(const string& name, vector<Vec3>& values) {
        addList(name, "Vector", "", values);
    }
    void add(const char* name, Vec3 (&box)[3]) {
        vector<Vec3> vectors(box, box + 3);
        add(name, vectors);
        if (vectors.size() != 3)
            throwDamaged();
        std::copy(vectors.begin(), vectors.end(), box);
    }
    void add(const char* name, Lists& lists) {
        NodeForm form = inside(name);
        if (to == nullptr)
            for (const SerializationNode& list : form.from->getChildren())
                lists[list.getName()];
        for (auto& list : lists)
            form.add(list.first, list.second);
    }
    void addIfAny(const char* name, vector<double>& values) {
        bool isThere = to != nullptr && !values.empty();
        if (to == nullptr)
            for (const SerializationNode& child : from->getChildren())
                isThere = isThere || child.getName() == name;
        if (isThere)
            add(name, values);
    }

private:
    NodeForm inside(const string& name) {
        return to != nullptr ? NodeForm(&to->createChildNode(name), nullptr)
                             : NodeForm(nullptr, &from->getChildNode(name));
    }
    template <class T>
    void addList(const string& name, const char* itemName, const char* numberName, vector<T>& values) {
        NodeForm list = inside(name);
        if (to == nullptr)
            values.resize(list.from->getChildren().size());
        for (size_t i = 0; i < values.size(); i++) {
            NodeForm item = to != nullptr ? list.inside(itemName) : NodeForm(nullptr, &list.from->getChildren()[i]);
            item.add(numberName, values[i]);
        }
    }
    SerializationNode* to; // or null
    const SerializationNode* from;
};

// What is written down of a run: all of its members, in this order, with the names that they have in XML.
template <class Form> void exchange(RunState& run, Form form) {
    form.add("system", run.system);
    form.add("context", run.context);
    form.add("parameters", run.parameters);
    form.add("areForcesOutdated", run.areForcesOutdated);
    form.add("lastStepSize", run.lastStepSize);
    form.add("lastDensity", run.lastDensity);
    form.add("References", run.findings.references);
    form.add("referenceTemperature", run.findings.referenceTemperature);
    form.addIfAny("RandomState", run.findings.random);
    form.add("startsAfresh", run.startsAfresh);
    if (run.startsAfresh)
        return;
    form.add("Method", run.methodValues);
    form.add("HalfStepVelocities", run.halfStepVelocities);
    form.add("Forces", run.forces);
    form.add("groupEnergy", run.groupEnergy);
    form.add("BoxVectors", run.boxVectors);
    form.add("Positions", run.positions);
    form.add("Velocities", run.velocities);
    form.add("isContextAhead", run.isContextAhead);
    form.add("ContextPositions", run.contextPositions);
    form.add("ContextVelocities", run.contextVelocities);
}

} // namespace

// Writing changes nothing.
void RunState::write(std::ostream& stream) const {
    exchange(const_cast<RunState&>(*this), BinaryForm(&stream, nullptr));
}

void RunState::read(std::istream& stream) {
    exchange(*this, BinaryForm(nullptr, &stream));
}

void RunState::write(SerializationNode& node) const {
    exchange(const_cast<RunState&>(*this), NodeForm(&node, nullptr));
}

void RunState::read(const SerializationNode& node) {
    exchange(*this, NodeForm(nullptr, &node));
}

const vector<double>& RunState::getMethodValues(const string& name, size_t count) const {
    auto entry = methodValues.find(name);
    if (entry == methodValues.end() || entry->second.size() != count)
        throwDamaged();
    return entry->second;
}

void RunState::Archive::add(const string& name, vector<double>& values, size_t count) {
    if (to != nullptr)
        to->methodValues[name] = values;
    else
        values = from.getMethodValues(name, count);
}

void RunState::Archive::add(const string& name, const vector<double*>& numbers) {
    vector<double> list;
    for (const double* number : numbers)
        list.push_back(*number);
    add(name, list, list.size());
    for (size_t i = 0; i < list.size(); i++)
        *numbers[i] = list[i];
}

void RunState::requireSizes(int numParticles, int numMonitors) const {
    bool fits = (int) findings.references.size() == numMonitors;
    if (!startsAfresh)
        fits = fits && (int) forces.size() == numParticles;
    for (const vector<Vec3>* optional :
         {&halfStepVelocities, &positions, &velocities, &contextPositions, &contextVelocities})
        fits = fits && (optional->empty() || (int) optional->size() == numParticles);
    if (!fits)
        throwDamaged();
}
