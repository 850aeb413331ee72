"""A pure-torch 3D Gaussian Splatting trainer for CPU and CUDA that demonstrates `ca_reg` end to end."""

import ctypes
import os

# PyTorch's own threads otherwise spin for milliseconds after every operation, on the processors that the threads of the
# loops need. It counts where this package is imported before PyTorch, and in every process that is started from here.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

# The C library (glibc) otherwise returns memory to the system after a step and gets it anew, page by page, in the next.
# It keeps up to 256 MiB, unless its own variables say how much.
if not {"GLIBC_TUNABLES", "MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"} & set(os.environ):
    try:
        for _threshold in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
            ctypes.CDLL(None).mallopt(_threshold, 256 << 20)
    except (AttributeError, OSError, TypeError):  # another C library
        pass
