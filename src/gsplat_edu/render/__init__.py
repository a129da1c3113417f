"""Gaussians and a camera in, an image out: projection, sort and compositing, once per backend."""
