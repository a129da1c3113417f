"""Diagnose problems of a capture before training and of a scene after it."""
