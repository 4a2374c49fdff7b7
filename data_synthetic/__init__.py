"""Phantoms with known motion, closed-form fields, random masks: for tests, demos and benchmarks."""
