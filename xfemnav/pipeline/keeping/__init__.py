"""What is kept on disk: cache, names, records, locks, compiled kernels."""
