# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Puts what a benchmark has measured into the page of the documentation that shows it.

A page has pairs of comments for that, `<!-- measured: NAME -->` and `<!-- end: NAME -->`. All between the two is
written by the benchmark, with the command, the day, the versions and the processor, and is not edited by hand.
"""

from __future__ import annotations

import datetime
import os
import platform
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import openmm
import openmmvrattle

DOCS = Path(__file__).resolve().parents[1] / "docs"


def processor() -> str:
    """The name of this machine's processor and how many of its cores are at hand."""
    name = platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        found = re.search(r"^model name\s*: (.+)$", information.read_text(encoding="utf-8"), re.MULTILINE)
        name = found[1].strip() if found else name
    return f"{len(os.sched_getaffinity(0))} cores of {name}"


def provenance(device: str | None = None) -> str:
    """A line that says by which command, when and where the numbers below it were measured.

    Args:
        device: what computed, if that was not the processor.
    """
    command = shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    today = datetime.date.today()
    return (
        f"*Written by `{command}` on {today.day} {today:%B %Y}: OpenMM-VRATTLE {openmmvrattle.__version__}, OpenMM "
        f"{openmm.Platform.getOpenMMVersion()}, {device or processor()}.*"
    )


def write(page: Path, name: str, lines: Sequence[str]) -> None:
    """Put lines between the comments of a page.

    Args:
        page: the file.
        name: which comments.
        lines: what is to stand there.

    Raises:
        ValueError: if the page has no such comments, or has them twice.
    """
    text = page.read_text(encoding="utf-8")
    pattern = rf"(<!-- measured: {re.escape(name)} -->\n).*?(<!-- end: {re.escape(name)} -->\n)"
    block = "\n".join(lines).strip("\n")
    new, count = re.subn(pattern, lambda found: f"{found[1]}\n{block}\n\n{found[2]}", text, flags=re.DOTALL)
    if count != 1:
        raise ValueError(f"{page} has {count} places for the measurement {name}, and there must be one.")
    page.write_text(new, encoding="utf-8")
