"""Surveys of captures and of trained scenes, and what can be found in them; the doctor and the parts judge by these."""
