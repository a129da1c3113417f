"""The backend cpu: native SIMD kernels, in `native/`."""
