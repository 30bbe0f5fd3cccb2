"""What taccorl uses of scipy.signal. It ships no types, and to infer them from its code takes pyright two minutes."""

from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

@overload
def butter(
    N: int,
    Wn: ArrayLike,
    btype: str = ...,
    analog: bool = ...,
    *,
    output: Literal["sos"],
    fs: float | None = ...,
) -> np.ndarray: ...
@overload
def butter(
    N: int,
    Wn: ArrayLike,
    btype: str = ...,
    analog: bool = ...,
    output: str = ...,
    fs: float | None = ...,
) -> Any: ...
def sosfiltfilt(
    sos: ArrayLike,
    x: ArrayLike,
    axis: int = ...,
    padtype: str | None = ...,
    padlen: int | None = ...,
) -> np.ndarray: ...
@overload
def lfilter(
    b: ArrayLike, a: ArrayLike, x: ArrayLike, axis: int = ..., zi: None = ...
) -> np.ndarray: ...
@overload
def lfilter(
    b: ArrayLike, a: ArrayLike, x: ArrayLike, axis: int = ..., *, zi: ArrayLike
) -> tuple[np.ndarray, np.ndarray]: ...
def savgol_coeffs(
    window_length: int,
    polyorder: int,
    deriv: int = ...,
    delta: float = ...,
    pos: int | None = ...,
    use: str = ...,
) -> np.ndarray: ...
def savgol_filter(
    x: ArrayLike,
    window_length: int,
    polyorder: int,
    deriv: int = ...,
    delta: float = ...,
    axis: int = ...,
    mode: str = ...,
    cval: float = ...,
) -> np.ndarray: ...
def cont2discrete(
    system: tuple[ArrayLike, ...],
    dt: float,
    method: str = ...,
    alpha: float | None = ...,
) -> tuple[Any, ...]: ...
def fftconvolve(
    in1: ArrayLike, in2: ArrayLike, mode: str = ..., axes: int | None = ...
) -> np.ndarray: ...
