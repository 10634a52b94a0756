"""Numbers that carry their derivatives: forward differentiation through the transfer matrix.

A `Dual` is an array with tangents with respect to K real parameters. The transfer-matrix code is written in numpy
functions that dispatch to it, so that the derivative goes through the very same recursion as the value and is exact.
Only the operations that this recursion needs are known; any other raises `TypeError`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Dual"]


class Dual:
    """An array and its tangents.

    Parameters
    ----------
    value : `numpy.ndarray`
        Real or complex values.
    tangent : `numpy.ndarray`, shape ``(K, *value.shape)``
        Derivative of the value with respect to each of K real parameters.
    """

    def __init__(self, value: NDArray[Any], tangent: NDArray[Any]) -> None:
        self.value = np.asarray(value)
        self.tangent = np.asarray(tangent)
        if self.tangent.shape[1:] != self.value.shape:
            raise ValueError(f"tangent {self.tangent.shape} does not belong to value {self.value.shape}")

    @classmethod
    def constant(cls, value: NDArray[Any], count: int) -> Dual:
        """An array that does not depend on any of ``count`` parameters."""
        value = np.asarray(value)
        return cls(value, np.zeros((count, *value.shape), dtype=value.dtype))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the value."""
        return self.value.shape

    @property
    def ndim(self) -> int:
        """Number of axes of the value."""
        return self.value.ndim

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the value."""
        return self.value.dtype

    @property
    def real(self) -> Dual:
        """Real part."""
        return Dual(self.value.real, self.tangent.real)

    @property
    def imag(self) -> Dual:
        """Imaginary part."""
        return Dual(self.value.imag, self.tangent.imag)

    def __len__(self) -> int:
        return len(self.value)

    def __getitem__(self, key: Any) -> Dual:
        return Dual(self.value[key], self.tangent[(slice(None), *_as_tuple(key))])

    def __setitem__(self, key: Any, item: Any) -> None:
        other = _lift(item, len(self.tangent))
        self.value[key] = other.value
        self.tangent[(slice(None), *_as_tuple(key))] = other.tangent

    def __lt__(self, other: Any) -> NDArray[np.bool_]:
        return np.asarray(self.value < _value(other))

    def __eq__(self, other: object) -> NDArray[np.bool_]:  # type: ignore[override]
        return np.asarray(self.value == _value(other))

    __hash__ = None  # type: ignore[assignment]

    def reshape(self, *shape: Any) -> Dual:
        """The same numbers in another shape."""
        flat = shape[0] if len(shape) == 1 and isinstance(shape[0], tuple) else shape
        value = self.value.reshape(flat)
        return Dual(value, self.tangent.reshape(len(self.tangent), *value.shape))

    def __neg__(self) -> Dual:
        return Dual(-self.value, -self.tangent)

    def __add__(self, other: Any) -> Dual:
        one, two = _pair(self, other)
        return Dual(one.value + two.value, one.tangent + two.tangent)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Dual:
        return self + (-other)

    def __rsub__(self, other: Any) -> Dual:
        return (-self) + other

    def __mul__(self, other: Any) -> Dual:
        one, two = _pair(self, other)
        return Dual(one.value * two.value, one.tangent * two.value + one.value * two.tangent)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Dual:
        one, two = _pair(self, other)
        ratio = one.value / two.value
        return Dual(ratio, (one.tangent - ratio * two.tangent) / two.value)

    def __rtruediv__(self, other: Any) -> Dual:
        return _lift(other, len(self.tangent)) / self

    def __pow__(self, exponent: int) -> Dual:
        if exponent != 2:
            raise TypeError("only squares of dual numbers are known")
        return self * self

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Dual:
        rule = _RULES.get(ufunc)
        if method != "__call__" or options or rule is None:
            raise TypeError(f"numpy.{ufunc.__name__} is not known for dual numbers")
        return rule(*inputs)

    def __array_function__(
        self, function: Callable[..., Any], types: Any, args: tuple[Any, ...], options: dict[str, Any]
    ) -> Any:
        rule = _FUNCTIONS.get(function)
        if rule is None:
            raise TypeError(f"numpy.{function.__name__} is not known for dual numbers")
        return rule(*args, **options)


def _as_tuple(key: Any) -> tuple[Any, ...]:
    return key if isinstance(key, tuple) else (key,)


def _value(item: Any) -> NDArray[Any]:
    return item.value if isinstance(item, Dual) else np.asarray(item)


def _lift(item: Any, count: int) -> Dual:
    return item if isinstance(item, Dual) else Dual.constant(np.asarray(item), count)


def _pair(one: Any, other: Any) -> tuple[Dual, Dual]:
    """Both as dual numbers with equally many axes, so that tangents broadcast like values."""
    count = len(one.tangent) if isinstance(one, Dual) else len(other.tangent)
    first, second = _lift(one, count), _lift(other, count)
    axes = max(first.ndim, second.ndim)
    return _padded(first, axes), _padded(second, axes)


def _padded(item: Dual, axes: int) -> Dual:
    return item.reshape((1,) * (axes - item.ndim) + item.shape)


def _chain(function: Callable[..., Any], slope: Callable[..., Any]) -> Callable[[Dual], Dual]:
    def rule(item: Dual) -> Dual:
        value = function(item.value)
        return Dual(value, slope(item.value, value) * item.tangent)

    return rule


def _absolute(item: Dual) -> Dual:
    size = np.abs(item.value)
    direction = np.conj(item.value) / np.where(size == 0.0, 1.0, size)
    return Dual(size, (direction * item.tangent).real)


_RULES: dict[np.ufunc, Callable[..., Dual]] = {
    np.add: lambda one, two: two + one if isinstance(two, Dual) else one + two,
    np.subtract: lambda one, two: (-two) + one if isinstance(two, Dual) else one - two,
    np.multiply: lambda one, two: two * one if isinstance(two, Dual) else one * two,
    np.true_divide: lambda one, two: (
        _lift(one, len(two.tangent)) / two if isinstance(two, Dual) else one / two
    ),
    np.power: lambda one, two: one**two,
    np.exp: _chain(np.exp, lambda x, y: y),
    np.sqrt: _chain(np.sqrt, lambda x, y: 0.5 / y),
    np.sin: _chain(np.sin, lambda x, y: np.cos(x)),
    np.conjugate: lambda item: Dual(np.conj(item.value), np.conj(item.tangent)),
    np.absolute: _absolute,
}


def _stack(items: Sequence[Any], axis: int = 0) -> Dual:
    count = next(len(item.tangent) for item in items if isinstance(item, Dual))
    lifted = [_lift(item, count) for item in items]
    return Dual(
        np.stack([item.value for item in lifted], axis),
        np.stack([item.tangent for item in lifted], axis + 1 if axis >= 0 else axis),
    )


def _where(condition: NDArray[np.bool_], one: Any, two: Any) -> Dual:
    first, second = _pair(one, two)
    return Dual(
        np.where(condition, first.value, second.value), np.where(condition, first.tangent, second.tangent)
    )


def _broadcast_to(item: Dual, shape: tuple[int, ...]) -> Dual:
    padded = _padded(item, len(shape))
    return Dual(
        np.broadcast_to(padded.value, shape), np.broadcast_to(padded.tangent, (len(item.tangent), *shape))
    )


_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.stack: _stack,
    np.where: _where,
    np.broadcast_to: _broadcast_to,
    np.empty_like: lambda item: Dual(np.empty_like(item.value), np.zeros_like(item.tangent)),
    np.zeros_like: lambda item: Dual(np.zeros_like(item.value), np.zeros_like(item.tangent)),
    np.any: lambda item: np.any(item.value),
}
