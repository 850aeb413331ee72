"""The engine of Triton kernels, for NVIDIA and AMD cards."""
