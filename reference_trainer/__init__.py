"""A 3D Gaussian Splatting trainer in PyTorch, numba and Triton, for CPU and CUDA, that shows `ca_reg` end to end."""

import ctypes
import os

# PyTorch's OpenMP threads otherwise spin for milliseconds after every operation, on the cores that the compiled loops
# need. It takes effect where this package is imported before PyTorch, and in every process started from here.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

# glibc otherwise returns memory to the system after every step and faults it in again, page by page, in the next.
# Let it keep up to 256 MiB, unless the user has set its own variables.
if not {"GLIBC_TUNABLES", "MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"} & set(os.environ):
    try:
        for _threshold in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
            ctypes.CDLL(None).mallopt(_threshold, 256 << 20)
    except (AttributeError, OSError, TypeError):  # another C library
        pass
