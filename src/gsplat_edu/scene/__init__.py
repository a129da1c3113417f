"""What is rendered, and from where: Gaussians, cameras, views, harmonics, and orders in space."""
