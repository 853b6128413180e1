"""Eight float32 lanes as one numba value, so that the compositing loop keeps its sums in vector registers.

LLVM's loop vectoriser gives up on short rows (trip count 8) and stores every accumulator back to memory; with an
explicit vector type the inner loop is what is written. Every operation is one LLVM vector instruction, so it runs on
any CPU: AVX2 uses one register, SSE and NEON two.

numba's cache watches only the file of the function it stores: after an edit here or in `projection.py`'s constants,
touch `kernels.py`.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 8
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, LANES)
#: Minimax fit of 2**f, |f| <= 1/2, lowest power first: relative error 7.5e-8 before rounding.
_EXP2 = (1.00000012, 0.693146944, 0.240221202, 0.0555071309, 0.00967554096, 0.00132764701)


class _Float32x8(types.Type):
    def __init__(self):
        super().__init__(name="float32x8")


float32x8 = _Float32x8()


@register_model(_Float32x8)
class _Float32x8Model(models.PrimitiveModel):
    def __init__(self, manager, fe_type):
        super().__init__(manager, fe_type, _VECTOR)


def _register_operator(function, instruction: str) -> None:
    """Give `float32x8 op float32x8` its LLVM instruction."""

    @infer_global(function)
    class _Template(ConcreteTemplate):
        cases = [signature(float32x8, float32x8, float32x8)]

    @lower_builtin(function, float32x8, float32x8)
    def _lower(context, builder, sig, args):
        return getattr(builder, instruction)(*args)


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _register_operator(_function, _instruction)


def _splat(builder, scalar):
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), zeros)


def _fma(builder, a, b, c):
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
    return builder.call(builder.module.declare_intrinsic("llvm.fmuladd.v8f32", (), kind), [a, b, c])


def _address(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


@intrinsic
def splat(typingctx, scalar):
    """All lanes = float32 `scalar`."""
    return float32x8(types.float32), lambda context, builder, sig, args: _splat(builder, args[0])


@intrinsic
def iota(typingctx):
    """Lanes 0, 1, ..., 7."""

    def codegen(context, builder, sig, args):
        return ir.Constant(_VECTOR, [float(i) for i in range(LANES)])

    return float32x8(), codegen


@intrinsic
def load(typingctx, array, index):
    """array[index : index + 8] of a contiguous 1-D float32 array; the caller keeps it in bounds."""

    def codegen(context, builder, sig, args):
        pointer = _address(context, builder, sig.args[0], args[0], args[1])
        return builder.load(builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)

    return float32x8(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + 8] = value."""

    def codegen(context, builder, sig, args):
        pointer = _address(context, builder, sig.args[0], args[0], args[1])
        builder.store(args[2], builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, float32x8), codegen


@intrinsic
def fma(typingctx, a, b, c):
    """a * b + c, fused where the CPU can."""

    def codegen(context, builder, sig, args):
        return _fma(builder, *args)

    return float32x8(float32x8, float32x8, float32x8), codegen


@intrinsic
def exp2(typingctx, x):
    """2**x for -126 < x < 127, relative error < 2e-7: exponent bits for round(x), a polynomial for the rest."""

    def codegen(context, builder, sig, args):
        integers = ir.VectorType(ir.IntType(32), LANES)
        magic = ir.Constant(_VECTOR, [12582912.0] * LANES)  # 1.5 * 2**23: adding it rounds to an integer
        shifted = builder.fadd(args[0], magic)
        fraction = builder.fsub(args[0], builder.fsub(shifted, magic))
        value = ir.Constant(_VECTOR, [_EXP2[-1]] * LANES)
        for coefficient in _EXP2[-2::-1]:
            value = _fma(builder, value, fraction, ir.Constant(_VECTOR, [coefficient] * LANES))
        exponent = builder.shl(builder.bitcast(shifted, integers), ir.Constant(integers, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, integers), exponent), _VECTOR)

    return float32x8(float32x8), codegen


@intrinsic
def fnma(typingctx, a, b, c):
    """c - a * b, fused where the CPU can."""

    def codegen(context, builder, sig, args):
        return _fma(builder, builder.fneg(args[0]), args[1], args[2])

    return float32x8(float32x8, float32x8, float32x8), codegen


@intrinsic
def sqrt(typingctx, a):
    """Square root per lane."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        return builder.call(builder.module.declare_intrinsic("llvm.sqrt.v8f32", (), kind), args)

    return float32x8(float32x8), codegen


@intrinsic
def select_gt(typingctx, a, b, yes, no):
    """Per lane: a > b ? yes : no (NaN gives no)."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return float32x8(float32x8, float32x8, float32x8, float32x8), codegen


@intrinsic
def mask_gt(typingctx, a, b):
    """uint64 whose bit i says a > b in lane i (NaN gives 0)."""

    def codegen(context, builder, sig, args):
        mask = builder.bitcast(builder.fcmp_ordered(">", args[0], args[1]), ir.IntType(LANES))
        return builder.zext(mask, ir.IntType(64))

    return types.uint64(float32x8, float32x8), codegen


@intrinsic
def trailing_zeros(typingctx, mask):
    """Index of the lowest set bit of a uint64 that is not 0."""

    def codegen(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), codegen


def _sum_of(builder, a, b, even, odd):
    """shuffle(a, b, even) + shuffle(a, b, odd), a tree step of a sum over lanes."""
    kind = ir.VectorType(ir.IntType(32), LANES)
    left, right = (builder.shuffle_vector(a, b, ir.Constant(kind, order)) for order in (even, odd))
    return builder.fadd(left, right)


@intrinsic
def totals(typingctx, a, b, c, d, e, f, g, h):
    """The sums over lanes of eight vectors as one vector, pairwise in one fixed order, so that results repeat."""

    def codegen(context, builder, sig, args):
        pairs = ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15])
        quads = ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15])
        halves = ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15])
        vectors = list(args)
        for even, odd in (pairs, quads, halves):
            vectors = [_sum_of(builder, *vectors[i : i + 2], even, odd) for i in range(0, len(vectors), 2)]
        return vectors[0]

    return float32x8(*[float32x8] * 8), codegen


@intrinsic
def total(typingctx, a):
    """The sum over lanes, pairwise in one fixed order."""

    def codegen(context, builder, sig, args):
        value = args[0]
        for half in (4, 2, 1):
            order = [(i + half) % LANES for i in range(LANES)]
            value = _sum_of(builder, value, value, list(range(LANES)), order)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(float32x8), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of array[index], a contiguous 1-D array, ahead of its use."""

    def codegen(context, builder, sig, args):
        pointer = _address(context, builder, sig.args[0], args[0], args[1])
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        i32 = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, i32, i32, i32])
        function = builder.module.declare_intrinsic("llvm.prefetch", [pointer.type], kind)
        builder.call(function, [pointer, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen
