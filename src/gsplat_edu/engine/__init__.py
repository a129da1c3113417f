"""Kernels in WGSL for any GPU: their description as data, and the host that plays it through wgpu."""
