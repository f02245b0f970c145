"""Align colour with sparse depth and complete the depth, with one small network."""

__version__ = "0.1.0"
