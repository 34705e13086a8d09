# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Integrators compared, and advice from a trial run: what the commands ``compare`` and ``advise`` are made of.

Running and measuring needs OpenMM and NumPy alone, pictures and tables more: pip install "openmm-vrattle[compare]".
"""
