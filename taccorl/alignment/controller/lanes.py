"""A number type for Numba, ``lanes``: a vector of ``LANES`` floats, one of each of ``LANES`` simulations that run at once.

The processor does an operation on eight floats in one or two instructions, so that eight simulations of a joint take little
longer than one. Operators, comparisons and functions are those of floats, lane by lane; a float is the same number in each lane.
``where`` takes the place of ``if``. LLVM may reorder sums, and round a product and a sum once.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic as _intrinsic
from numba.extending import models, register_model

LANES = 8
"""Number of floats in a vector: as many as fit an AVX-512 register; narrower processors take several instructions."""
_FREE = (
    "contract",
    "arcp",
    "nsz",
    "reassoc",
)  # what LLVM may change in a sum or product; not: NaN and infinity
_VECTOR, _BITS = (
    ir.VectorType(ir.DoubleType(), LANES),
    ir.VectorType(ir.IntType(1), LANES),
)
_WHOLE = ir.VectorType(ir.IntType(64), LANES)


def intrinsic(function: Callable[..., Any]) -> Callable[..., Any]:
    """``numba.extending.intrinsic``, which has no type annotations."""
    return _intrinsic(function)


class Lanes(types.Type):
    """Type of ``LANES`` floats."""

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Conversion | None:
        """Whether ``other`` is a number."""
        return Conversion.safe if isinstance(other, types.Number) else None


class Mask(types.Type):
    """Type of a condition in each lane."""


lanes, mask = Lanes("lanes"), Mask("mask")
for _type, _vector in ((Lanes, _VECTOR), (Mask, _BITS)):
    _init = {
        "__init__": lambda self, dmm, fe_type, be=_vector: (
            models.PrimitiveModel.__init__(self, dmm, fe_type, be)
        )
    }
    register_model(_type)(type("Model", (models.PrimitiveModel,), _init))


def _of_number(
    context: Any, builder: Any, of: types.Type, to: types.Type, value: Any
) -> Any:
    number, any_ = (
        context.cast(builder, value, of, types.float64),
        ir.Constant(_VECTOR, ir.Undefined),
    )
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(
        builder.insert_element(any_, number, ir.IntType(32)(0)), any_, zeros
    )


for _number in (types.Float, types.Integer, types.IntegerLiteral):
    lower_cast(_number, lanes)(_of_number)


def _known(
    function: Any,
    build: Callable[..., Any],
    count: int,
    of: types.Type = lanes,
    to: types.Type = lanes,
) -> None:
    """Register ``function`` of ``count`` arguments with Numba; ``build(context, builder, *values)`` emits LLVM code."""
    template = type(
        "Template", (ConcreteTemplate,), {"cases": [signature(to, *[of] * count)]}
    )
    infer_global(function)(template)  # pyright: ignore[reportOptionalCall]
    lower_builtin(function, *[of] * count)(
        lambda context, builder, _, values: build(context, builder, *values)
    )


def _llvm(name: str) -> Callable[..., Any]:
    def build(context: Any, builder: Any, *values: Any) -> Any:
        of = ir.FunctionType(_VECTOR, [_VECTOR] * len(values))
        return builder.call(
            cgutils.get_or_insert_function(
                builder.module, of, f"llvm.{name}.v{LANES}f64"
            ),
            values,
        )

    return build


def _times_power_of_two(context: Any, builder: Any, x: Any, k: Any) -> Any:
    """x 2ᵏ for −1022 ≤ k ≤ 1023: k is the exponent of a float of mantissa 1."""
    exponent = builder.add(builder.fptosi(k, _WHOLE), _WHOLE([1023] * LANES))
    return builder.fmul(
        x, builder.bitcast(builder.shl(exponent, _WHOLE([52] * LANES)), _VECTOR)
    )


for _name, _does in (
    ("add", "fadd"),
    ("sub", "fsub"),
    ("mul", "fmul"),
    ("truediv", "fdiv"),
):
    for _operator in (getattr(operator, _name), getattr(operator, f"i{_name}")):
        _known(
            _operator,
            lambda c, b, x, y, does=_does: getattr(b, does)(x, y, flags=_FREE),
            2,
        )
for _name, _sign in (
    ("lt", "<"),
    ("gt", ">"),
    ("le", "<="),
    ("ge", ">="),
    ("eq", "=="),
):
    _known(
        getattr(operator, _name),
        lambda c, b, x, y, sign=_sign: b.fcmp_ordered(sign, x, y),
        2,
        lanes,
        mask,
    )
_known(operator.ne, lambda c, b, x, y: b.fcmp_unordered("!=", x, y), 2, lanes, mask)
_known(operator.neg, lambda c, b, x: b.fneg(x), 1)
_known(operator.and_, lambda c, b, x, y: b.and_(x, y), 2, mask, mask)
_known(operator.or_, lambda c, b, x, y: b.or_(x, y), 2, mask, mask)
for _function, _sign in ((min, "<"), (max, ">")):
    _known(
        _function,
        lambda c, b, x, y, sign=_sign: b.select(b.fcmp_ordered(sign, y, x), y, x),
        2,
    )
for _function, _name, _count in (
    (abs, "fabs", 1),
    (math.floor, "floor", 1),
    (math.copysign, "copysign", 2),
):
    _known(_function, _llvm(_name), _count)
_known(math.ldexp, _times_power_of_two, 2)


@intrinsic
def where(typingctx: Any, condition: Any, yes: Any, no: Any) -> Any:
    """``yes`` in the lanes in which ``condition`` is true, ``no`` in the others."""
    return lanes(
        mask, lanes, lanes
    ), lambda context, builder, _, values: builder.select(*values)


@intrinsic
def holds(typingctx: Any, condition: Any) -> Any:
    """Whether ``condition`` is true in any lane."""
    bits = ir.IntType(LANES)
    return types.boolean(mask), lambda c, b, _, values: b.icmp_unsigned(
        "!=", b.bitcast(values[0], bits), bits(0)
    )


@intrinsic
def _exponent(typingctx: Any, x: Any) -> Any:
    """Binary exponent k of lanes x > 0: x = m · 2ᵏ with 1 ≤ m < 2."""

    def build(context: Any, builder: Any, _: Any, values: Any) -> Any:
        bits = builder.lshr(builder.bitcast(values[0], _WHOLE), _WHOLE([52] * LANES))
        return builder.sitofp(builder.sub(bits, _WHOLE([1023] * LANES)), _VECTOR)

    return lanes(lanes), build


def _place(context: Any, builder: Any, array: types.Array, values: Any) -> Any:
    data = context.make_array(array)(context, builder, values[0]).data
    place = builder.gep(
        data, [builder.mul(values[1], context.get_constant(types.int64, LANES))]
    )
    return builder.bitcast(place, _VECTOR.as_pointer())


def _row(context: Any, builder: Any, array: types.Array, values: Any) -> Any:
    return builder.load(_place(context, builder, array, values), align=8)


@intrinsic
def load(typingctx: Any, rows: Any, row: Any) -> Any:
    """Row ``row`` of an array (R, LANES)."""
    return lanes(rows, types.int64), lambda c, b, called, values: _row(
        c, b, called.args[0], values
    )


def fields_as(kind: Any) -> Callable[..., Any]:
    """Compiled function that turns an array (fields, LANES) into a named tuple of the class ``kind``, lanes in each field."""
    whole = types.NamedUniTuple(lanes, len(kind._fields), kind)

    def fields(typingctx: Any, numbers: Any) -> Any:
        def build(context: Any, builder: Any, _: Any, values: Any) -> Any:
            places = [context.get_constant(types.int64, k) for k in range(len(whole))]
            rows = [
                _row(context, builder, numbers, (values[0], place)) for place in places
            ]
            return context.make_tuple(builder, whole, rows)

        return whole(numbers), build

    return intrinsic(fields)


@intrinsic
def store(typingctx: Any, rows: Any, row: Any, values: Any) -> Any:
    """Set row ``row`` of an array (R, LANES)."""

    def build(context: Any, builder: Any, called: Any, given: Any) -> Any:
        builder.store(
            given[2], _place(context, builder, called.args[0], given), align=8
        )
        return context.get_dummy_value()

    return types.none(rows, types.int64, lanes), build


# π / 2 in three parts, and coefficients of z = r² from FreeBSD's k_sin.c and k_cos.c: sin r = r + r z S(z), cos r = 1 − z / 2 +
# z² C(z).
_QUARTER = (
    1.57079632673412561417,
    6.07710050650619224932e-11,
    2.02226624879595063154e-21,
)
_S = (-1.66666666666666324348e-1, 8.33333333332248946124e-3, -1.98412698298579493134e-4)
_S += (
    2.75573137070700676789e-6,
    -2.50507602534068634195e-8,
    1.58969099521155010221e-10,
)
_C = (4.16666666666666019037e-2, -1.38888888888741095749e-3, 2.48015872894767294178e-5)
_C += (
    -2.75573143513906633035e-7,
    2.08757232129817482790e-9,
    -1.13596475577881948265e-11,
)
_LN2 = (0.6931471803691238, 1.9082149292705877e-10)  # ln 2, in two parts
_TAYLOR = tuple(1.0 / math.factorial(k) for k in range(13 + 1))
_ODD = tuple(2.0 / (2 * k + 1) for k in range(11))
compiled = numba.njit(cache=True, forceinline=True)


@compiled
def _series(z: Any, zz: Any, c: Any) -> Any:
    return (c[0] + z * c[1]) + zz * ((c[2] + z * c[3]) + zz * (c[4] + z * c[5]))


@compiled
def sine_and_cosine(angle: Any) -> Any:
    """Sine and cosine of lanes [rad]; absolute error below 1e-15 up to ± 10 rad."""
    k = math.floor(angle * (2.0 / math.pi) + 0.5)
    r = ((angle - k * _QUARTER[0]) - k * _QUARTER[1]) - k * _QUARTER[2]
    z, quarter = r * r, k - 4.0 * math.floor(0.25 * k)
    sine, cosine = (
        r + r * z * _series(z, z * z, _S),
        1.0 - (0.5 * z - z * z * _series(z, z * z, _C)),
    )
    odd = (quarter == 1.0) | (quarter == 3.0)
    sine, cosine = where(odd, cosine, sine), where(odd, sine, cosine)
    return where(quarter >= 2.0, -sine, sine), where(
        (quarter == 1.0) | (quarter == 2.0), -cosine, cosine
    )


@compiled
def decayed(x: Any) -> Any:
    """exp(−x) of lanes, and, where x ≥ 0, (1 − exp(−x)) / x; relative errors below 1e-15 and 1e-12."""
    x = max(min(x, 700.0), -700.0)
    k = math.floor(0.5 - x / math.log(2.0))
    r, t = (-x - k * _LN2[0]) - k * _LN2[1], _TAYLOR
    high = _series(r, r * r, t[6:12]) + r * r * r * r * r * r * (t[12] + r * t[13])
    left = math.ldexp(_series(r, r * r, t[:6]) + r * r * r * r * r * r * high, k)
    short = 1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0)))
    return left, where(x > 1e-3, (1.0 - left) / x, short)


@compiled
def power(x: Any, exponent: Any) -> Any:
    """x to the power of ``exponent``, of lanes x > 0; relative error below 1e-15 (1 + |exponent · ln x|)."""
    k = _exponent(x)
    m = math.ldexp(x, -k)
    k, m = where(m > math.sqrt(2.0), k + 1.0, k), where(m > math.sqrt(2.0), 0.5 * m, m)
    s = (m - 1.0) / (m + 1.0)
    z, t = s * s, _ODD  # ln m = 2 (s + s³ / 3 + s⁵ / 5 …)
    high = t[6] + z * t[7] + z * z * ((t[8] + z * t[9]) + z * z * t[10])
    logarithm = k * _LN2[0] + (
        k * _LN2[1] + s * (_series(z, z * z, t[:6]) + z * z * z * z * z * z * high)
    )
    return decayed(-exponent * logarithm)[0]
