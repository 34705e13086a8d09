// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

#include "ExpressionTexts.h"
#include <algorithm>
#include <cmath>
#include <locale>
#include <map>
#include <sstream>
#include <string>

using namespace OpenMMVRattle;
using std::string;
using std::vector;

namespace {

const string DIGITS = "0123456789", SPACES = " \t\n\r\f\v", ENDS = "+-*/^(),;=" + SPACES;
const string PREFIX = "~"; // of the parameters' names, in which users have no reason to begin theirs

// A text without the numbers that may be parameters, in whose places there are none.
struct Pattern {
    vector<string> pieces; // before, between and behind the numbers
    vector<string> numbers;
    string key() const {
        string result = std::to_string(numbers.size());
        for (const string& piece : pieces)
            result += piece + PREFIX;
        return result;
    }
};

// 0 if it is none.
double readNumber(const string& number) {
    std::istringstream text(number);
    text.imbue(std::locale::classic());
    double value = 0;
    text >> value;
    return text.fail() ? 0.0 : value;
}

// Where the number ends that begins at a place, as Lepton reads it.
size_t findEndOfNumber(const string& text, size_t at) {
    bool hasPoint = text[at] == '.', hasExponent = false;
    for (at++; at < text.size(); at++) {
        if (text[at] == '.' && !hasPoint)
            hasPoint = true;
        else if ((text[at] == 'e' || text[at] == 'E') && !hasExponent) {
            hasExponent = true;
            if (at + 1 < text.size() && (text[at + 1] == '-' || text[at + 1] == '+'))
                at++;
        }
        else if (DIGITS.find(text[at]) == string::npos)
            break;
    }
    return at;
}

bool isNumberAt(const string& text, size_t at) {
    return at < text.size() && (text[at] == '.' || DIGITS.find(text[at]) != string::npos);
}

// The end of an exponent that is a number, perhaps with a sign and in parentheses; npos if it is not.
size_t findEndOfExponent(const string& text, size_t at) {
    at = text.find_first_not_of(SPACES, at);
    const bool isEnclosed = at < text.size() && text[at] == '(';
    if (isEnclosed)
        at = text.find_first_not_of(SPACES, at + 1);
    if (at < text.size() && text[at] == '-')
        at = text.find_first_not_of(SPACES, at + 1);
    if (!isNumberAt(text, at))
        return string::npos;
    at = findEndOfNumber(text, at);
    if (isEnclosed)
        at = text.find_first_not_of(SPACES, at);
    return !isEnclosed ? at : at < text.size() && text[at] == ')' ? at + 1 : string::npos;
}

Pattern findPattern(const ExpressionConstraint& constraint) {
    const string& text = constraint.expression;
    const Pattern whole{{text}, {}};
    if (!constraint.parameters.empty() && constraint.parameters.rbegin()->first >= PREFIX)
        return whole;
    Pattern pattern{{""}, {}};
    for (size_t at = 0; at < text.size();) {
        size_t end = at + 1;
        if (text[at] == '^') {
            end = findEndOfExponent(text, end);
            if (end == string::npos) // who knows what that depends on
                return whole;
        }
        else if (isNumberAt(text, at)) {
            end = findEndOfNumber(text, at);
            const string number = text.substr(at, end - at);
            if (readNumber(number) != 0 && std::isfinite(readNumber(number))) {
                pattern.numbers.push_back(number);
                pattern.pieces.emplace_back();
                at = end;
                continue;
            }
        }
        else if (ENDS.find(text[at]) == string::npos) // a name
            end = std::min(text.find_first_of(ENDS, at), text.size());
        pattern.pieces.back() += text.substr(at, end - at);
        at = end;
    }
    return pattern;
}

} // namespace

vector<ExpressionConstraint> OpenMMVRattle::shareTexts(const vector<ExpressionConstraint>& expressions) {
    vector<Pattern> patterns;
    struct Shared {
        int first;
        vector<bool> differs; // of each number, whether it is not the same in all texts
    };
    std::map<string, Shared> known;
    for (const ExpressionConstraint& constraint : expressions) {
        patterns.push_back(findPattern(constraint));
        const Pattern& pattern = patterns.back();
        const size_t count = pattern.numbers.size();
        Shared& shared =
            known.insert({pattern.key(), {(int) patterns.size() - 1, vector<bool>(count, false)}}).first->second;
        for (size_t k = 0; k < count; k++)
            if (pattern.numbers[k] != patterns[shared.first].numbers[k])
                shared.differs[k] = true;
    }
    vector<ExpressionConstraint> result = expressions;
    for (size_t i = 0; i < result.size(); i++) {
        const Pattern& pattern = patterns[i];
        const Shared& shared = known.at(pattern.key());
        string& text = result[i].expression;
        text = pattern.pieces[0];
        for (size_t k = 0; k < pattern.numbers.size(); k++) {
            if (shared.differs[k]) {
                const string name = PREFIX + std::to_string(k);
                result[i].parameters[name] = readNumber(pattern.numbers[k]);
                text += name;
            }
            else
                text += pattern.numbers[k];
            text += pattern.pieces[k + 1];
        }
    }
    return result;
}
