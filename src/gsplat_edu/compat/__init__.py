"""Interfaces of other rasterisers over our kernels."""

from gsplat_edu.compat.unmodified import install, uninstall

__all__ = ["install", "uninstall"]
