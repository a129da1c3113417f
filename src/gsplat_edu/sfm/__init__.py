"""Structure from motion: convert photos or a video without poses to a COLMAP capture."""
