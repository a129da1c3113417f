"""Where views come from: a folder on disk, or a scene we render ourselves."""
