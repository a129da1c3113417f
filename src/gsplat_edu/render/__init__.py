"""Render Gaussians from a camera: projection, sorting and compositing, with one implementation per backend."""
