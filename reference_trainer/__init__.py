"""A pure-torch 3D Gaussian Splatting trainer for CPU and CUDA that demonstrates `ca_reg` end to end."""

import os

# PyTorch's own threads otherwise spin for milliseconds after every operation, on the processors that the threads of the
# loops need. It counts where this package is imported before PyTorch, and in every process that is started from here.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")
