"""Runs, results and sessions."""
