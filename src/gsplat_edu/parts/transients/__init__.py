"""Masks of things that move."""
