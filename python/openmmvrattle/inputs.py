# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The old name of openmmvrattle.compare.inputs."""

from ._moved import moved

moved(__name__)
