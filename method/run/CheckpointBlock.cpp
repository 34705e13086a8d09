// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "run/CheckpointBlock.h"
#include "openmm/OpenMMException.h"
#include "run/Fingerprint.h"
#include <algorithm>
#include <cstring>
#include <istream>
#include <ostream>

using namespace OpenMMVRattle;
using OpenMM::OpenMMException;
using std::string;

namespace {

const char MARK[8] = {'V', 'R', 'A', 'T', 'T', 'L', 'E', '\n'};
// 2: fingerprints of box and parameters, no force groups; 3: parameters of expressions; 4: random numbers; 5: temperature of references;
// 6: another order of constraints, no u. What a run holds of constraints is in the order of ConstraintLayout: a change there is one here.
const int VERSION = 6;
const long long CHUNK = 1 << 20; // so that a damaged length does not ask for memory that the data do not fill

template <class T> bool readValue(std::istream& stream, T& value) {
    return bool(stream.read(reinterpret_cast<char*>(&value), sizeof(T)));
}

} // namespace

void CheckpointBlock::write(std::ostream& stream, const string& data) {
    const long long length = (long long) data.size();
    const unsigned long long fingerprint = fingerprintOf(data);
    stream.write(MARK, sizeof(MARK));
    stream.write(reinterpret_cast<const char*>(&VERSION), sizeof(VERSION));
    stream.write(reinterpret_cast<const char*>(&length), sizeof(length));
    stream.write(reinterpret_cast<const char*>(&fingerprint), sizeof(fingerprint));
    stream.write(data.data(), length);
}

bool CheckpointBlock::read(std::istream& stream, string& data) {
    const std::istream::pos_type start = stream.tellg();
    char mark[sizeof(MARK)];
    stream.read(mark, sizeof(MARK));
    const size_t length = (size_t) stream.gcount();
    if (length == 0 || std::memcmp(mark, MARK, length) != 0) {
        stream.clear();
        if (start != std::istream::pos_type(-1))
            stream.seekg(start);
        return false;
    }
    int version = 0;
    if (readValue(stream, version) && version != VERSION)
        throw OpenMMException("OpenMM-VRATTLE: this checkpoint is written in version " + std::to_string(version) +
                              " of its format and this plugin reads version " + std::to_string(VERSION) +
                              "; use the version of the plugin that wrote it");
    long long numBytes = 0;
    unsigned long long fingerprint = 0;
    data.clear();
    if (readValue(stream, numBytes) && readValue(stream, fingerprint)) {
        while ((long long) data.size() < numBytes && stream) {
            const size_t size = data.size(), wanted = (size_t) std::min(CHUNK, numBytes - (long long) size);
            data.resize(size + wanted);
            stream.read(&data[size], wanted);
            data.resize(size + (size_t) stream.gcount());
        }
    }
    if (!stream || (long long) data.size() != numBytes || fingerprintOf(data) != fingerprint)
        throw OpenMMException("OpenMM-VRATTLE: this checkpoint is damaged or cut short");
    return true;
}
