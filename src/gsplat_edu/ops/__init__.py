"""Operations on tensors with kernels of their own: losses, Adam, noise and colours, natively and in torch."""
