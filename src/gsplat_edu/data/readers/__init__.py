"""Readers of the poses of other programs, a module for each."""
