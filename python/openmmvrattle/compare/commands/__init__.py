# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The commands of ``python -m openmmvrattle`` that compare: a module for each."""
