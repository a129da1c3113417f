"""Scene files, one module per format."""
