"""2D splats: rendered, differentiated by hand and fitted to an image with Adam. NumPy only, without torch."""
