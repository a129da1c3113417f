"""Camera paths: orbits, keyframes and the curve through them, paths near a capture's cameras, and their lenses."""
