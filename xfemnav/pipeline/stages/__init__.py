"""The stages of the method, and their chain through the cache."""
