"""Depth that the user has, or that the points of the capture give."""
