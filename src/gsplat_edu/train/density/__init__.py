"""Density control: where the scene needs more Gaussians, and which ones it can do without."""
