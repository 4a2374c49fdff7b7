"""Configuration, storage, cache, the chain of stages, the report."""
