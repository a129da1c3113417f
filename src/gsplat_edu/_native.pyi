"""Types of the native module (native/bindings.cpp)."""

from collections.abc import Sequence

class FrameF32:
    num_visible: int
    num_pairs: int
    seconds: tuple[float, ...]
    def __init__(
        self,
        n: int,
        rest: int,
        scene: Sequence[int],
        view: Sequence[float],
        H: int,
        W: int,
        sh_degree: int,
        antialiased: bool,
        threads: int,
    ) -> None: ...
    def composite(self, image: int, transmittance: int, depth: int) -> None: ...
    def backward(
        self,
        n: int,
        rest: int,
        scene: Sequence[int],
        forward: Sequence[int],
        incoming: Sequence[int],
        outgoing: Sequence[int],
        background: int,
    ) -> None: ...
    def visible(self, ids: int, radii: int) -> None: ...

class FrameF64(FrameF32): ...

def adam_f32(arrays: Sequence[int], size: int, numbers: Sequence[float], threads: int) -> None: ...
def adam_f64(arrays: Sequence[int], size: int, numbers: Sequence[float], threads: int) -> None: ...
def loss_f32(
    arrays: Sequence[int], H: int, W: int, ssim_weight: float, threads: int
) -> tuple[float, float]: ...
def loss_f64(
    arrays: Sequence[int], H: int, W: int, ssim_weight: float, threads: int
) -> tuple[float, float]: ...
def isas() -> list[str]: ...
def isa() -> str: ...
def choose_isa(name: str) -> None: ...
def fma_rate() -> float: ...
