"""Density control: add Gaussians where the scene needs them and remove superfluous ones."""
