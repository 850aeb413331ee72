"""The Gaussians: parameters, optimizer, relocation, rendering, PLY files."""
