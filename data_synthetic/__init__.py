"""Phantoms with known motion, closed-form fields, random masks: for tests, demos and benchmarks.

Installed as the package xfemnav_examples, for `xfemnav example`."""
