"""The backend cuda: project, intersect, composite, loss and Adam as Triton kernels."""
