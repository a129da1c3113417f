"""What makes Gaussians learn a surface, for meshes."""
