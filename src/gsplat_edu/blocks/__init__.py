"""Blocks: a capture too large for one machine is split on the ground, trained in parts, and merged."""
