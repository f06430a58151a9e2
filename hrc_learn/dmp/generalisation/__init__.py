"""Primitives from several demonstrations: distributions and contexts."""
