"""Types of the native module (native/bindings.cpp). Arrays are DLPack capsules, tensors or NumPy arrays."""

from collections.abc import Sequence

class Camera:
    def __init__(
        self,
        *,
        R: object,
        eye: object,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        x_bounds: Sequence[float],
        y_bounds: Sequence[float],
        H: int,
        W: int,
    ) -> None: ...

class Settings:
    def __init__(
        self,
        *,
        z_near: float,
        background: Sequence[float],
        sh_degree: int,
        antialiased: bool,
        dilation: float,
        alpha_max: float,
    ) -> None: ...

class Scene:
    def __init__(self, **arrays: object) -> None: ...

class Gradients:
    def __init__(self, *, means2d_norm: object, background: object, **arrays: object) -> None: ...

class Images:
    def __init__(
        self, *, image: object, transmittance: object, depth: object, features: object, median: object
    ) -> None: ...

class Statistics:
    def __init__(self, *, values: object, errors: object) -> None: ...

class FrameF32:
    num_visible: int
    num_pairs: int
    seconds: tuple[float, ...]
    processor_seconds: tuple[float, ...]
    parallel_seconds: tuple[float, ...]
    def __init__(self, *, scene: Scene, camera: Camera, settings: Settings, threads: int) -> None: ...
    def composite(self, *, images: Images, features: object) -> None: ...
    def backward(
        self,
        *,
        scene: Scene,
        images: Images,
        incoming: Images,
        gradients: Gradients,
        features: object,
        collected: Statistics | None,
    ) -> None: ...
    def visible(self, *, ids: object, radii: object) -> None: ...
    def tile_lists(self, *, begin: object, ids: object) -> None: ...

class FrameF64(FrameF32): ...

class Volume:
    blocks: int
    bytes: int
    def __init__(self, *, voxel: float, truncation: float, max_bytes: int) -> None: ...
    def integrate(
        self,
        *,
        depth: object,
        weights: object,
        image: object,
        R: object,
        eye: object,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        threads: int,
    ) -> None: ...
    def extract(self, *, min_weight: float, threads: int) -> tuple[object, object, object | None]: ...
    def load(self, *, places: object, distances: object, weights: object) -> None: ...
    def read(self, *, places: object, distances: object, weights: object) -> None: ...

def adam_f32(
    *,
    parameter: object,
    first: object,
    second: object,
    gradient: object,
    rate: float,
    beta1: float,
    beta2: float,
    eps: float,
    correction1: float,
    correction2: float,
    threads: int,
) -> None: ...
def adam_f64(
    *,
    parameter: object,
    first: object,
    second: object,
    gradient: object,
    rate: float,
    beta1: float,
    beta2: float,
    eps: float,
    correction1: float,
    correction2: float,
    threads: int,
) -> None: ...
def loss_f32(
    *, image: object, target: object, gradient: object, ssim_weight: float, threads: int
) -> tuple[float, float]: ...
def loss_f64(
    *, image: object, target: object, gradient: object, ssim_weight: float, threads: int
) -> tuple[float, float]: ...
def isas() -> list[str]: ...
def isa() -> str: ...
def choose_isa(name: str) -> None: ...
def fma_rate() -> float: ...
def parallel_time() -> tuple[float, float]: ...
