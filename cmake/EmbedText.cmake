# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
#
# Writes a C++ header with the text of files, as constants of a namespace named after them:
# cmake -DOUTPUT=<header> -DNAMESPACE=<name> "-DFILES=<file>;<file>..." -P EmbedText.cmake
# The text is cut into literals of 8,000 characters, since some compilers take no long ones.

set(header "// Made by cmake/EmbedText.cmake.\n#pragma once\n#include <string>\nnamespace ${NAMESPACE} {\n")
foreach(file IN LISTS FILES)
    cmake_path(GET file STEM name)
    file(READ "${file}" text)
    string(APPEND header "const std::string ${name} =")
    string(LENGTH "${text}" length)
    set(begin 0)
    while(begin LESS length)
        string(SUBSTRING "${text}" ${begin} 8000 piece)
        string(APPEND header "\n    std::string(R\"~~(${piece})~~\") +")
        math(EXPR begin "${begin} + 8000")
    endwhile()
    string(APPEND header " std::string();\n")
endforeach()
string(APPEND header "}\n")
file(WRITE "${OUTPUT}" "${header}")
