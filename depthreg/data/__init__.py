"""Frames and measurements: the contract, files, data sets."""
