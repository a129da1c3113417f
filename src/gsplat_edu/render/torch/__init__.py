"""The backend torch: every splat at every pixel, by torch's operations and autograd."""
