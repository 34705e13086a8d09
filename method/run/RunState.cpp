// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/RunState.h"
#include "openmm/OpenMMException.h"
#include "run/Fingerprint.h"
#include "run/IntegratorSettings.h"
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

template <class T> void writeValue(std::ostream& stream, const T& value) {
    stream.write(reinterpret_cast<const char*>(&value), sizeof(T));
}

template <class T> void readValue(std::istream& stream, T& value) {
    if (!stream.read(reinterpret_cast<char*>(&value), sizeof(T)))
        throwDamaged();
}

template <class T> void writeArray(std::ostream& stream, const vector<T>& values) {
    writeValue(stream, (long long) values.size());
    for (const T& value : values)
        writeValue(stream, value);
}

template <class T> void readArray(std::istream& stream, vector<T>& values) {
    long long size;
    readValue(stream, size);
    values.clear();
    for (long long i = 0; i < size; i++) { // grows no further than the stream goes, whatever the size says
        values.emplace_back();
        readValue(stream, values.back());
    }
}

void writeArray(SerializationNode& node, const string& name, const vector<double>& values) {
    SerializationNode& array = node.createChildNode(name);
    for (double value : values)
        array.createChildNode("Value").setDoubleProperty("v", value);
}

void readArray(const SerializationNode& node, const string& name, vector<double>& values) {
    values.clear();
    for (const SerializationNode& child : node.getChildNode(name).getChildren())
        values.push_back(child.getDoubleProperty("v"));
}

void writeArray(SerializationNode& node, const string& name, const vector<Vec3>& values) {
    SerializationNode& array = node.createChildNode(name);
    for (const Vec3& v : values)
        array.createChildNode("Vector").setDoubleProperty("x", v[0]).setDoubleProperty("y", v[1]).setDoubleProperty(
            "z", v[2]);
}

void readArray(const SerializationNode& node, const string& name, vector<Vec3>& values) {
    values.clear();
    for (const SerializationNode& v : node.getChildNode(name).getChildren())
        values.emplace_back(v.getDoubleProperty("x"), v.getDoubleProperty("y"), v.getDoubleProperty("z"));
}

} // namespace

unsigned long long RunState::fingerprintOf(const OpenMM::System& system, const IntegratorSettings& settings) {
    Fingerprint fingerprint;
    for (int i = 0; i < system.getNumParticles(); i++)
        fingerprint.add(system.getParticleMass(i));
    for (int i = 0; i < system.getNumConstraints(); i++) {
        int particle1, particle2;
        double distance;
        system.getConstraintParameters(i, particle1, particle2, distance);
        fingerprint.add(Vec3(particle1, particle2, distance));
    }
    for (const ExpressionConstraint& constraint : settings.expressions) {
        fingerprint.addBytes(constraint.expression.c_str(), constraint.expression.size() + 1);
        for (int particle : constraint.particles)
            fingerprint.add(particle);
        for (const auto& parameter : constraint.parameters)
            fingerprint.addBytes(parameter.first.c_str(), parameter.first.size() + 1);
    }
    return fingerprint.get();
}

void RunState::write(std::ostream& stream) const {
    writeValue(stream, system);
    writeValue(stream, context);
    writeValue(stream, parameters);
    writeValue(stream, areForcesOutdated);
    writeValue(stream, lastStepSize);
    writeValue(stream, lastDensity);
    writeArray(stream, references);
    writeValue(stream, referenceTemperature);
    writeArray(stream, randomState);
    writeValue(stream, startsAfresh);
    if (startsAfresh)
        return;
    writeValue(stream, (long long) methodValues.size());
    for (const auto& entry : methodValues) {
        writeArray(stream, vector<char>(entry.first.begin(), entry.first.end()));
        writeArray(stream, entry.second);
    }
    writeArray(stream, halfStepVelocities);
    writeArray(stream, forces);
    writeValue(stream, groupEnergy);
    writeValue(stream, boxVectors);
    writeArray(stream, positions);
    writeArray(stream, velocities);
    writeValue(stream, isContextAhead);
    writeArray(stream, contextPositions);
    writeArray(stream, contextVelocities);
}

void RunState::read(std::istream& stream) {
    readValue(stream, system);
    readValue(stream, context);
    readValue(stream, parameters);
    readValue(stream, areForcesOutdated);
    readValue(stream, lastStepSize);
    readValue(stream, lastDensity);
    readArray(stream, references);
    readValue(stream, referenceTemperature);
    readArray(stream, randomState);
    readValue(stream, startsAfresh);
    if (startsAfresh)
        return;
    long long numEntries;
    readValue(stream, numEntries);
    for (long long i = 0; i < numEntries; i++) {
        vector<char> name;
        readArray(stream, name);
        readArray(stream, methodValues[string(name.begin(), name.end())]);
    }
    readArray(stream, halfStepVelocities);
    readArray(stream, forces);
    readValue(stream, groupEnergy);
    readValue(stream, boxVectors);
    readArray(stream, positions);
    readArray(stream, velocities);
    readValue(stream, isContextAhead);
    readArray(stream, contextPositions);
    readArray(stream, contextVelocities);
}

void RunState::write(SerializationNode& node) const {
    node.setLongProperty("system", (long long) system).setLongProperty("context", (long long) context);
    node.setLongProperty("parameters", (long long) parameters).setBoolProperty("areForcesOutdated", areForcesOutdated);
    node.setDoubleProperty("lastStepSize", lastStepSize).setDoubleProperty("lastDensity", lastDensity);
    writeArray(node, "References", references);
    node.setDoubleProperty("referenceTemperature", referenceTemperature);
    if (!randomState.empty())
        writeArray(node, "RandomState", randomState);
    node.setBoolProperty("startsAfresh", startsAfresh);
    if (startsAfresh)
        return;
    SerializationNode& method = node.createChildNode("Method");
    for (const auto& entry : methodValues)
        writeArray(method, entry.first, entry.second);
    writeArray(node, "HalfStepVelocities", halfStepVelocities);
    writeArray(node, "Forces", forces);
    node.setDoubleProperty("groupEnergy", groupEnergy);
    writeArray(node, "BoxVectors", vector<Vec3>(boxVectors, boxVectors + 3));
    writeArray(node, "Positions", positions);
    writeArray(node, "Velocities", velocities);
    node.setBoolProperty("isContextAhead", isContextAhead);
    writeArray(node, "ContextPositions", contextPositions);
    writeArray(node, "ContextVelocities", contextVelocities);
}

void RunState::read(const SerializationNode& node) {
    system = (unsigned long long) node.getLongProperty("system");
    context = (unsigned long long) node.getLongProperty("context");
    parameters = (unsigned long long) node.getLongProperty("parameters");
    areForcesOutdated = node.getBoolProperty("areForcesOutdated");
    lastStepSize = node.getDoubleProperty("lastStepSize");
    lastDensity = node.getDoubleProperty("lastDensity");
    readArray(node, "References", references);
    referenceTemperature = node.getDoubleProperty("referenceTemperature", 0.0);
    for (const SerializationNode& child : node.getChildren())
        if (child.getName() == "RandomState")
            readArray(node, "RandomState", randomState);
    startsAfresh = node.getBoolProperty("startsAfresh");
    if (startsAfresh)
        return;
    for (const SerializationNode& entry : node.getChildNode("Method").getChildren())
        readArray(node.getChildNode("Method"), entry.getName(), methodValues[entry.getName()]);
    readArray(node, "HalfStepVelocities", halfStepVelocities);
    readArray(node, "Forces", forces);
    groupEnergy = node.getDoubleProperty("groupEnergy");
    vector<Vec3> box;
    readArray(node, "BoxVectors", box);
    if (box.size() != 3)
        throwDamaged();
    for (int i = 0; i < 3; i++)
        boxVectors[i] = box[i];
    readArray(node, "Positions", positions);
    readArray(node, "Velocities", velocities);
    isContextAhead = node.getBoolProperty("isContextAhead");
    readArray(node, "ContextPositions", contextPositions);
    readArray(node, "ContextVelocities", contextVelocities);
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

void RunState::Archive::add(const string& name, double* values, size_t count) {
    vector<double> list(values, values + count);
    add(name, list, count);
    std::copy(list.begin(), list.end(), values);
}

void RunState::requireSizes(int numParticles, int numMonitors) const {
    bool fits = (int) references.size() == numMonitors;
    if (!startsAfresh)
        fits = fits && (int) forces.size() == numParticles;
    for (const vector<Vec3>* optional :
         {&halfStepVelocities, &positions, &velocities, &contextPositions, &contextVelocities})
        fits = fits && (optional->empty() || (int) optional->size() == numParticles);
    if (!fits)
        throwDamaged();
}
