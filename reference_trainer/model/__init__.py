"""The Gaussians: parameters, optimizer, density control, PLY files."""
