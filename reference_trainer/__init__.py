"""A pure-torch 3D Gaussian Splatting trainer for CPU and CUDA that demonstrates `ca_reg` end to end."""
