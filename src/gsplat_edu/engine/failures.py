"""What wgpu raises becomes one line that names the adapter and what to do."""

from __future__ import annotations

from gsplat_edu.base.errors import BackendUnavailableError


class one_line:  # noqa: N801  used like a function
    """Turns what wgpu raises into one line."""

    def __init__(self, what: str) -> None:
        self.what = what

    def __enter__(self) -> None:
        """Nothing to prepare."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        """Translate errors of wgpu."""
        if error is not None and _is_of_wgpu(error):
            raise BackendUnavailableError(
                f"backend 'webgpu': {self.what} ({first_line(error)}); use the backend cpu"
            ) from error


def _is_of_wgpu(error: BaseException) -> bool:
    import wgpu

    return isinstance(error, (wgpu.GPUError, RuntimeError))


def first_line(error: BaseException) -> str:
    """Return the kind of an error and the first line that it says."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
