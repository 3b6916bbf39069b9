"""Poses together with shape coefficients and sizes."""
