"""Runs: the folder of a training, its files, and its evaluation."""
