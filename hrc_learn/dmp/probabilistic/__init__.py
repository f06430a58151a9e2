"""Primitives from several demonstrations: distributions, via points and contexts."""
