"""The engine of Triton kernels, for NVIDIA and AMD cards.

Raises:
    ImportError: where Triton is older than 3.4, which compiles none of the kernels that take tuples.
"""

import re

import triton

if [int(part) for part in re.findall(r"\d+", triton.__version__)[:2]] < [3, 4]:
    raise ImportError(f"the kernels need Triton 3.4 or newer, which comes with torch 2.8, got {triton.__version__}")
