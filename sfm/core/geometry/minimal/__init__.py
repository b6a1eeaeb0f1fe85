"""Minimal solvers, one per file."""
