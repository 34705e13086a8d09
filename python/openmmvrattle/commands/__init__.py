# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The command line ``python -m openmmvrattle``: one module for each of its commands."""
