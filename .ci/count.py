# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""count.py REPORT...: how many tests passed and failed, from JUnit XML as ctest and pytest write it."""

import sys
import xml.etree.ElementTree
from pathlib import Path

passed = failed = 0
for path in sys.argv[1:]:
    if not Path(path).exists():  # make stopped before this report was written
        continue
    for case in xml.etree.ElementTree.parse(path).iter("testcase"):
        # ctest calls a program that it did not find "notrun".
        if case.get("status") == "notrun" or any(case.find(tag) is not None for tag in ("failure", "error")):
            failed += 1
        elif case.find("skipped") is None:
            passed += 1
print(f"{passed} passed, {failed} failed")
