"""A picture made of 2D splats: rendered, differentiated by hand, fitted with Adam. In NumPy, without torch."""
