"""Short vectors of numbers as values inside compiled loops, for what LLVM does not vectorise by itself.

A loop vectoriser has to prove that arrays do not overlap, and small matrix products need blocks of accumulators that
stay in registers. Here both are written down: `load` sixteen numbers beside each other, `times_plus` them, `store`
them. Processors with shorter registers take several for each vector. Indices are not checked. Arrays of 16-bit integers
hold the upper halves of numbers, as bfloat16 has them: they are loaded as numbers and stored rounded.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

LANES = 16
"""Numbers of a long vector."""
QUAD = 4
"""Numbers of a short one."""
_CONTRACT = ("contract",)


def _operation(generator: Callable[..., Any]) -> Any:
    """What a function says of its types and of the code to generate, as a function for compiled loops."""
    return intrinsic(generator)


class _Vector(types.Type):
    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(name=f"Vector{count}")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: _Vector) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.FloatType(), fe_type.count))


_LONG, _SHORT = _Vector(LANES), _Vector(QUAD)


def _place(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """Pointer to array[row, column]."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return cgutils.get_item_pointer(context, builder, signature.args[0], array, list(args[1:3]), wraparound=False)


def _loader(kind: _Vector) -> Any:
    def load(typing_context: Any, array: Any, row: Any, column: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pointer, vector = _place(context, builder, signature, args), context.get_value_type(kind)
            if array.dtype != types.int16:
                return builder.load(builder.bitcast(pointer, vector.as_pointer()), align=4)
            whole = ir.VectorType(ir.IntType(32), kind.count)
            halves = builder.load(builder.bitcast(pointer, _halves(kind).as_pointer()), align=2)
            shift = ir.Constant(whole, [16] * kind.count)
            return builder.bitcast(builder.shl(builder.zext(halves, whole), shift), vector)

        return kind(array, types.intp, types.intp), generate

    return _operation(load)


def _halves(kind: _Vector) -> Any:
    return ir.VectorType(ir.IntType(16), kind.count)


def _rounded(builder: Any, value: Any, kind: _Vector) -> Any:
    """Upper halves, rounded to the nearest, to the even one between two."""
    whole = ir.VectorType(ir.IntType(32), kind.count)

    def number(constant: int) -> Any:
        return ir.Constant(whole, [constant] * kind.count)

    bits = builder.bitcast(value, whole)
    odd = builder.and_(builder.lshr(bits, number(16)), number(1))
    bits = builder.add(bits, builder.add(odd, number(0x7FFF)))
    return builder.trunc(builder.lshr(bits, number(16)), _halves(kind))


def _storer(kind: _Vector) -> Any:
    def store(typing_context: Any, array: Any, row: Any, column: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pointer = _place(context, builder, signature, args)
            half = array.dtype == types.int16
            value = _rounded(builder, args[3], kind) if half else args[3]
            builder.store(value, builder.bitcast(pointer, value.type.as_pointer()), align=2 if half else 4)
            return context.get_dummy_value()

        return types.void(array, types.intp, types.intp, kind), generate

    return _operation(store)


def _filled(builder: Any, scalar: Any, count: int) -> Any:
    """A vector whose numbers are all the same."""
    vector = ir.VectorType(ir.FloatType(), count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count))


load, load4 = _loader(_LONG), _loader(_SHORT)
"""array[row, column : column + 16], and column + 4."""
store, store4 = _storer(_LONG), _storer(_SHORT)
"""array[row, column : column + 16] = value, and column + 4."""


@_operation
def apart(typing_context: Any) -> Any:
    """Keeps the function that calls it in one piece: copied into each of its callers it takes long to compile."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), generate


@_operation
def spread(typing_context: Any, array: Any, row: Any, column: Any) -> Any:
    """array[row, column], sixteen times."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _filled(builder, builder.load(_place(context, builder, signature, args), align=4), LANES)

    return _LONG(array, types.intp, types.intp), generate


@_operation
def fill(typing_context: Any, scalar: Any) -> Any:
    """A number, sixteen times."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _filled(builder, args[0], LANES)

    return _LONG(types.float32), generate


@_operation
def times_plus(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c; in one operation where the processor has it."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(builder.fmul(args[0], args[1], flags=_CONTRACT), args[2], flags=_CONTRACT)

    return a(a, a, a), generate


@_operation
def scaled_plus(typing_context: Any, scalar: Any, b: Any, c: Any) -> Any:
    """A number times a vector plus a vector."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        factor = _filled(builder, args[0], args[1].type.count)
        return builder.fadd(builder.fmul(factor, args[1], flags=_CONTRACT), args[2], flags=_CONTRACT)

    return b(types.float32, b, b), generate


@_operation
def scaled(typing_context: Any, scalar: Any, a: Any) -> Any:
    """A number times a vector."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(_filled(builder, args[0], args[1].type.count), args[1])

    return a(types.float32, a), generate


@_operation
def between(typing_context: Any, scalar: Any, a: Any, b: Any) -> Any:
    """a + scalar (b - a)."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        factor = _filled(builder, args[0], args[1].type.count)
        difference = builder.fsub(args[2], args[1])
        return builder.fadd(builder.fmul(factor, difference, flags=_CONTRACT), args[1], flags=_CONTRACT)

    return a(types.float32, a, a), generate


@_operation
def minus(typing_context: Any, a: Any, b: Any) -> Any:
    """a - b."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fsub(args[0], args[1])

    return a(a, a), generate


@_operation
def where_positive(typing_context: Any, condition: Any, value: Any) -> Any:
    """The value where the condition is positive, else zero; of a vector with itself, its rectification."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        zero = ir.Constant(args[0].type, [0.0] * args[0].type.count)
        return builder.select(builder.fcmp_ordered(">", args[0], zero), args[1], zero)

    return value(value, value), generate


@_operation
def sum_of_products(typing_context: Any, a: Any, b: Any) -> Any:
    """The scalar product of two short vectors."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        product = builder.fmul(args[0], args[1])
        parts = [builder.extract_element(product, ir.Constant(ir.IntType(32), i)) for i in range(args[0].type.count)]
        while len(parts) > 1:
            parts = [builder.fadd(x, y) for x, y in zip(parts[::2], parts[1::2], strict=True)]
        return parts[0]

    return types.float32(a, a), generate


@_operation
def plus(typing_context: Any, a: Any, b: Any) -> Any:
    """a + b."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(args[0], args[1])

    return a(a, a), generate


@_operation
def over_root(typing_context: Any, a: Any, square: Any, scale: Any, epsilon: Any) -> Any:
    """a / (scale sqrt(square) + epsilon)."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = args[0].type
        name, signature = f"llvm.sqrt.v{kind.count}f32", ir.FunctionType(kind, [kind])
        rooted = builder.call(cgutils.get_or_insert_function(builder.module, signature, name), [args[1]])
        scaled = builder.fmul(_filled(builder, args[2], kind.count), rooted)
        return builder.fdiv(args[0], builder.fadd(scaled, _filled(builder, args[3], kind.count)))

    return a(a, a, types.float32, types.float32), generate


_LOG2_E = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 0.693359375, -2.12194440e-4
_EXPONENTIAL = (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
"""Of (e^r - 1 - r) / r^2 for |r| up to ln(2) / 2, the highest power first; from the Cephes library."""
_LOWEST, _HIGHEST = -87.0, 88.0


@_operation
def exponential(typing_context: Any, a: Any) -> Any:
    r"""e^a to 2e-7 of itself, for a between -87 and 88; further out as at these ends.

    $e^a = 2^n e^r$ with $n$ the whole number next to $a / \ln 2$ and $r = a - n \ln 2$.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = args[0].type
        whole = ir.VectorType(ir.IntType(32), kind.count)

        def number(value: float) -> Any:
            return ir.Constant(kind, [value] * kind.count)

        def plus_product(x: Any, y: Any, z: Any) -> Any:
            return builder.fadd(builder.fmul(x, y, flags=_CONTRACT), z, flags=_CONTRACT)

        x = builder.select(builder.fcmp_ordered("<", args[0], number(_LOWEST)), number(_LOWEST), args[0])
        x = builder.select(builder.fcmp_ordered(">", x, number(_HIGHEST)), number(_HIGHEST), x)
        shifted = plus_product(x, number(_LOG2_E), number(127.5))
        power = builder.fptosi(shifted, whole)  # positive, so cut off is rounded down
        n = builder.fsub(builder.sitofp(power, kind), number(127.0))
        r = plus_product(n, number(-_LN2_HIGH), x)
        r = plus_product(n, number(-_LN2_LOW), r)
        total = number(_EXPONENTIAL[0])
        for coefficient in _EXPONENTIAL[1:]:
            total = plus_product(total, r, number(coefficient))
        total = builder.fadd(plus_product(builder.fmul(r, r), total, r), number(1.0))
        bits = builder.shl(power, ir.Constant(whole, [23] * kind.count))
        return builder.fmul(total, builder.bitcast(bits, kind))

    return a(a), generate


@_operation
def distinct(typing_context: Any, a: Any) -> Any:
    """Numbers that are not negative, to 2e-6 of themselves, made so that no two of a vector are equal."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        count = args[0].type.count
        whole = ir.VectorType(ir.IntType(32), count)
        bits = builder.and_(builder.bitcast(args[0], whole), ir.Constant(whole, [-count] * count))
        return builder.bitcast(builder.or_(bits, ir.Constant(whole, list(range(count)))), args[0].type)

    return a(a), generate


@_operation
def one_more_where_less(typing_context: Any, a: Any, b: Any, count: Any) -> Any:
    """The count, and one more where a < b."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = args[0].type
        one, zero = (ir.Constant(kind, [value] * kind.count) for value in (1.0, 0.0))
        return builder.fadd(args[2], builder.select(builder.fcmp_ordered("<", args[0], args[1]), one, zero))

    return a(a, a, a), generate


def _one_further(builder: Any, a: Any, first: float) -> Any:
    """A vector's numbers one place further back, behind `first`."""
    count = a.type.count
    before = ir.Constant(a.type, [first] * count)
    order = ir.Constant(ir.VectorType(ir.IntType(32), count), [count, *range(count - 1)])
    return builder.shuffle_vector(a, before, order)


@_operation
def insert(typing_context: Any, ascending: Any, value: Any) -> Any:
    """Ascending numbers with another one in its place; the last of them falls out."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        old, new = args[0], _filled(builder, args[1], args[0].type.count)
        moved = _one_further(builder, old, float("-inf"))
        moved = builder.select(builder.fcmp_ordered(">", moved, new), moved, new)
        return builder.select(builder.fcmp_ordered(">", old, new), moved, old)

    return ascending(ascending, types.float32), generate


@_operation
def insert_beside(typing_context: Any, ascending: Any, value: Any, others: Any, other: Any) -> Any:
    """Numbers that stand beside ascending ones, with another in the place where `insert` puts its value."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        old, count = args[0], args[0].type.count
        new, beside = _filled(builder, args[1], count), _filled(builder, args[3], count)
        stays = builder.fcmp_ordered(">", _one_further(builder, old, float("-inf")), new)
        moved = builder.select(stays, _one_further(builder, args[2], 0.0), beside)
        return builder.select(builder.fcmp_ordered(">", old, new), moved, args[2])

    return others(ascending, types.float32, others, types.float32), generate


@_operation
def larger(typing_context: Any, a: Any, b: Any) -> Any:
    """The larger number of each pair; the second where one is none."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[0], args[1])

    return a(a, a), generate


@_operation
def quotient(typing_context: Any, a: Any, b: Any) -> Any:
    """a / b."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fdiv(args[0], args[1])

    return a(a, a), generate
