"""Interfaces of other rasterisers over our kernels."""
