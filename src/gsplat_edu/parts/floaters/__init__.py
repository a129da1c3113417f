"""Splats that the photos do not support, removed from a trained scene."""
