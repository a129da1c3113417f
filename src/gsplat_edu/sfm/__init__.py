"""Structure from motion: photos or a video without poses become a COLMAP capture."""
