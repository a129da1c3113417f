"""Gaussians and a camera in, an image out: the same stages by the same names in every backend."""
