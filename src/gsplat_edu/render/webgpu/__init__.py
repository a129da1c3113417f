"""The backend webgpu: the WGSL kernels of `gsplat_edu.engine`, and a training that stays on the device."""
