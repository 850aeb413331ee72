"""Measurements for those who change this package: not installed, not timed by any test.

From the root of the checkout: ``python -m benchmarks.speed --help``, likewise ``growth``, ``plan`` and
``gradient_noise``.
"""

import reference_trainer  # noqa: F401  # before PyTorch: it says how long the threads of that spin
