"""The speed of the renderer as data: standard workloads, measured limits, a frozen baseline, and a regression gate."""
