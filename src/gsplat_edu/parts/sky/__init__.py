"""The sky of a capture: found in its photos, and placed behind its scene as far splats."""
