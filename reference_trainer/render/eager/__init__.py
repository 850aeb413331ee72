"""The engine of tensor operations."""
