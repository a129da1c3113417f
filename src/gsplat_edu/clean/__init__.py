"""Removes floaters, and what no camera supports, from a trained scene: the capture's photos are the judges."""
