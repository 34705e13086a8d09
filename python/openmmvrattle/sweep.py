# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The old name of openmmvrattle.compare.sweep."""

from ._moved import moved

moved(__name__)
