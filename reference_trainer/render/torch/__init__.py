"""The engine of PyTorch operations."""
