"""Runs: a folder per training, what is in it, and how it is judged."""
