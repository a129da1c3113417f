"""Judging a trained scene, and showing the judgement."""
