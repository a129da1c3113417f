"""Poses, lenses and rolling shutters of the cameras, refined with the scene."""
