"""Levels of detail: coarser versions of a scene, in the folders that viewers stream."""
