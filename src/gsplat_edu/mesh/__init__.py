"""Surfaces of scenes as triangle meshes."""
