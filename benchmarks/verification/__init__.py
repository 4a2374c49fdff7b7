"""Problems of fracture mechanics and of retraction with known answers, stated with xfemnav's public pieces."""

from xfemnav.pipeline.keeping.kernels import settle_kernel_cache

settle_kernel_cache()  # or numba would take kernels of other code for ours
