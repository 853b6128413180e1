"""Decorators for numba kernels, and a vector type for them: `LANES` or `WIDE` floats as one value.

LLVM's loop vectoriser gives up on a loop that reads a dozen rows and writes others, since it cannot prove that they do
not overlap (numba has no `noalias`), and on short rows it stores every sum back to memory. With a vector type each
operation of the inner loop is one LLVM instruction, which LLVM splits where registers are narrower. This makes lookups
in planes 2.6 to 4.5 times faster.

Sums are never reordered, and only functions of this module fuse operations, so that the bits of a result do not depend
on how often LLVM optimised a function. numba's fast math would break this: LLVM optimises a function on its own and
again inside the kernel that calls it.

Arrays are float32 or float64, C-contiguous, of any rank; an index is an offset into the flattened array, unchecked.

numba's cache watches only the file of the function it stores: after an edit here, touch the modules that import this.
"""

from __future__ import annotations

import functools
import gc
import operator
from collections.abc import Callable, Sequence
from typing import Any, Concatenate, ParamSpec, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, event, types
from numba.core.registry import cpu_target
from numba.cpython.unsafe import numbers
from numba.extending import intrinsic as _numba_intrinsic
from numba.extending import models, overload, register_model

from pd4dgs_codec import threads

LANES = 8
#: Floats in the widest register of the CPU that numba compiles for (its cache is keyed by that CPU).
WIDE = 16 if "+avx512f" in cpu_target.target_context.codegen().magic_tuple()[2] else LANES
#: Size of a `product`, rows and vectors of WIDE floats: its sums leave enough registers for the rows that are read.
PRODUCT_ROWS, PRODUCT_VECTORS = 12 if WIDE > LANES else 6, 2

CACHE_LINE = 64  #: bytes

Array = np.ndarray  #: in annotations of kernels
Vector = Any  #: in annotations of kernels: a value of the numba type `Lanes`
Tasks = tuple[int, int]  #: a half-open range of tasks
_Function = TypeVar("_Function", bound=Callable[..., Any])
_Arguments = ParamSpec("_Arguments")
_intrinsic: Callable[[Callable[..., Any]], Callable[..., Any]] = _numba_intrinsic


class _Uncollected(event.Listener):
    """Turns Python's garbage collection off while numba compiles: it took a sixth of the time."""

    depth, was_enabled = 0, False  #: guarded by numba's compiler lock

    def on_start(self, event: Any) -> None:
        if self.depth == 0:
            self.was_enabled = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0 and self.was_enabled:
            gc.enable()


event.register("numba:compile", _Uncollected())  # type: ignore[no-untyped-call]


def kernel(*, inline: bool = False) -> Callable[[_Function], _Function]:
    """Decorator of a function that numba compiles at its first call and caches beside its source.

    inline: inlines it into the kernels that call it; Python cannot call it. Divisions by zero follow IEEE 754; the
    interpreter's lock is released. Entries that nobody uses, for C and for Python, would take a tenth of compilation.
    """
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    if inline:
        options |= {"forceinline": True, "no_cpython_wrapper": True}

    def decorate(function: _Function) -> _Function:
        compiled: Any = numba.njit(**options)(function)
        template = compiled.get_call_template

        def get_call_template(args: Sequence[Any], named: dict[str, Any]) -> Any:
            """Gives constants in calls from other kernels their plain type: numba has a type per constant and would
            compile the function again for each. LLVM still propagates constants into inlined functions."""
            return template(tuple(map(types.unliteral, args)), named)

        compiled.get_call_template = get_call_template
        kernels: _Function = compiled
        return kernels

    return decorate


def parallel(
    tasks: Callable[..., int],
) -> Callable[[Callable[Concatenate[Tasks, _Arguments], None]], Callable[_Arguments, None]]:
    """Decorator of a `kernel` whose independent tasks are shared among threads; `tasks` counts them from its arguments.

    The kernel's first argument, which callers leave out, is the range of tasks to do. numba's own parallel loops take
    more than twice as long to compile and to load.
    """

    def decorate(function: Callable[Concatenate[Tasks, _Arguments], None]) -> Callable[_Arguments, None]:
        compiled, sharer = kernel()(function), threads.Sharer()

        @functools.wraps(compiled, updated=())  # sets `__wrapped__` to the kernel
        def call(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> None:
            sharer.share(tasks(*arguments, **named), lambda own: compiled(own, *arguments, **named))

        return call

    return decorate


class Lanes(types.Type):
    """The numba type of a vector of `count` scalars."""

    def __init__(self, scalar: types.Float, count: int):
        self.scalar, self.count = scalar, count
        super().__init__(name=f"Lanes({scalar}x{count})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Lanes):
        scalar = ir.FloatType() if fe_type.scalar.bitwidth == 32 else ir.DoubleType()
        super().__init__(manager, fe_type, ir.VectorType(scalar, fe_type.count))  # type: ignore[no-untyped-call]


def _define(op: Callable[..., Any], instruction: str) -> None:
    """Makes `vector op vector` one LLVM instruction, compiled with the options of the function around it."""

    @_intrinsic
    def apply(typingctx: Any, a: Any, b: Any) -> Any:
        return a(a, b), lambda context, builder, sig, args: getattr(builder, instruction)(*args)

    @overload(op)
    def _operator(a, b):  # type: ignore[no-untyped-def]  # numba compares its annotations with those of the function it returns
        return (lambda a, b: apply(a, b)) if isinstance(a, Lanes) and a == b else None


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")
_define(operator.truediv, "fdiv")


def _same(*vectors: Any) -> bool:
    return isinstance(vectors[0], Lanes) and all(v == vectors[0] for v in vectors)


def _readable(array: Any) -> bool:
    return isinstance(array, types.Array) and array.layout == "C" and isinstance(array.dtype, types.Float)


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Returns a pointer to element `index` of the flattened array."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def _constant(kind: Any, value: float) -> Any:
    return ir.Constant(kind, [value] * kind.count)


def _splat(builder: Any, scalar: Any, kind: Any) -> Any:
    """Returns a vector of the LLVM type `kind` with the scalar in every lane."""
    undefined, index = ir.Constant(kind, ir.Undefined), ir.IntType(32)
    first = builder.insert_element(undefined, scalar, index(0))
    return builder.shuffle_vector(first, undefined, _constant(ir.VectorType(index, kind.count), 0))


def _call(builder: Any, name: str, arguments: Sequence[Any]) -> Any:
    """Calls the LLVM intrinsic `name` on vectors of one type; the result has the same type."""
    kind = arguments[0].type
    width = 32 if isinstance(kind.element, ir.FloatType) else 64
    function_type = ir.FunctionType(kind, [kind] * len(arguments))
    function = builder.module.declare_intrinsic(f"llvm.{name}.v{kind.count}f{width}", (), function_type)
    return builder.call(function, arguments)


def _load(count: int) -> Callable[..., Any]:
    def function(typingctx: Any, array: Any, index: Any) -> Any:
        if not _readable(array):
            return None
        result = Lanes(array.dtype, count)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            pointer = _address(context, builder, sig.args[0], *args)
            pointer = builder.bitcast(pointer, context.get_value_type(result).as_pointer())
            return builder.load(pointer, align=array.dtype.bitwidth // 8)

        return result(array, types.intp), codegen

    return _intrinsic(function)


#: flat array[index : index + LANES], or of WIDE
load, wide_load = _load(LANES), _load(WIDE)


@_intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """flat array[index : index + lanes of the value] = value"""
    if not (_readable(array) and isinstance(value, Lanes) and value.scalar == array.dtype):
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _address(context, builder, sig.args[0], *args[:2])
        pointer = builder.bitcast(pointer, args[2].type.as_pointer())
        builder.store(args[2], pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


def _splat_of(count: int) -> Callable[..., Any]:
    def function(typingctx: Any, scalar: Any) -> Any:
        if not isinstance(scalar, types.Float):
            return None
        result = Lanes(scalar, count)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return _splat(builder, args[0], context.get_value_type(result))

        return result(scalar), codegen

    return _intrinsic(function)


#: The float `scalar` in each of LANES lanes, or of WIDE
splat, wide_splat = _splat_of(LANES), _splat_of(WIDE)


@_intrinsic
def spread(typingctx: Any, array: Any, index: Any) -> Any:
    """WIDE lanes: flat array[index] in the first LANES, and flat array[index + 1] in the others, if there are any."""
    if not _readable(array):
        return None
    result = Lanes(array.dtype, WIDE)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = context.get_value_type(result)
        few = ir.VectorType(kind.element, WIDE // LANES)
        pointer = builder.bitcast(_address(context, builder, sig.args[0], *args), few.as_pointer())
        values = builder.load(pointer, align=array.dtype.bitwidth // 8)
        chosen = ir.Constant(ir.VectorType(ir.IntType(32), WIDE), [i // LANES for i in range(WIDE)])
        return builder.shuffle_vector(values, ir.Constant(few, ir.Undefined), chosen)

    return result(array, types.intp), codegen


def _converted(scalar: types.Float, to: types.Float, instruction: str) -> Callable[..., Any]:
    def function(typingctx: Any, a: Any) -> Any:
        if not isinstance(a, Lanes) or a.scalar != scalar:
            return None
        result = Lanes(to, a.count)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return getattr(builder, instruction)(args[0], context.get_value_type(result))

        return result(a), codegen

    return _intrinsic(function)


#: float64 to float32, and float32 to float64
single = _converted(types.float64, types.float32, "fptrunc")
double = _converted(types.float32, types.float64, "fpext")


@_intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, fused where the CPU can."""
    if not _same(a, b, c):
        return None
    return a(a, b, c), lambda context, builder, sig, args: _call(builder, "fmuladd", args)


@_intrinsic
def fnma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """c - a * b, fused where the CPU can."""
    if not _same(a, b, c):
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, "fmuladd", [builder.fneg(args[0]), *args[1:]])

    return a(a, b, c), codegen


def _product(rows: int, vectors: int) -> Callable[..., Any]:
    """Makes a `product` of `rows` rows and `vectors` vectors of WIDE columns."""

    def function(
        typingctx: Any, y: Any, y_at: Any, y_row: Any, start: Any, start_at: Any, start_row: Any, a: Any, a_at: Any,
        a_row: Any, a_step: Any, b: Any, b_at: Any, b_row: Any, count: Any, relu: Any,
    ) -> Any:  # fmt: skip
        if not all(_readable(array) and array.dtype == y.dtype for array in (y, start, a, b)):
            return None

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = ir.VectorType(context.get_value_type(y.dtype), WIDE)
            align, index, whole = y.dtype.bitwidth // 8, ir.IntType(64), range(vectors)

            def row_at(first: int, step: Any, row: int) -> Any:
                """Returns a pointer to row `row` of the array at argument `first`, whose rows are `step` apart."""
                at = builder.add(args[first + 1], builder.mul(step, index(row)))
                return _address(context, builder, sig.args[first], args[first], at)

            def vector(pointer: Any, v: int) -> Any:
                return builder.bitcast(builder.gep(pointer, [index(v * WIDE)]), kind.as_pointer())

            new: Any = cgutils.alloca_once  # on the stack; LLVM makes them registers
            sums = [[new(builder, kind) for _ in whole] for _ in range(rows)]
            for row, own in enumerate(sums):
                for v in whole:
                    builder.store(builder.load(vector(row_at(3, args[5], row), v), align=align), own[v])
            scalars = [row_at(6, args[8], row) for row in range(rows)]
            with cgutils.for_range(builder, args[13], intp=index) as loop:
                pointer = builder.gep(row_at(10, args[12], 0), [builder.mul(loop.index, args[12])])
                factors = [builder.load(vector(pointer, v), align=align) for v in whole]
                at = builder.mul(loop.index, args[9])
                for scalar, own in zip(scalars, sums, strict=True):
                    factor = _splat(builder, builder.load(builder.gep(scalar, [at])), kind)
                    for v in whole:
                        builder.store(_call(builder, "fmuladd", [factor, factors[v], builder.load(own[v])]), own[v])
            zero, clamps = _constant(kind, 0.0), _splat(builder, args[14], ir.VectorType(ir.IntType(1), WIDE))
            for row, own in enumerate(sums):
                for v in whole:
                    value = builder.load(own[v])
                    negative = builder.and_(clamps, builder.fcmp_ordered("<", value, zero))
                    builder.store(
                        builder.select(negative, zero, value), vector(row_at(0, args[2], row), v), align=align
                    )
            return context.get_dummy_value()

        indices = dict.fromkeys((1, 2, 4, 5, 7, 8, 9, 11, 12, 13), types.intp)
        given = (y, y_at, y_row, start, start_at, start_row, a, a_at, a_row, a_step, b, b_at, b_row, count, relu)
        return types.void(*(indices.get(i, kind) for i, kind in enumerate(given))), codegen

    return _intrinsic(function)


#: y = start + a b, of PRODUCT_ROWS rows and PRODUCT_VECTORS * WIDE columns; with `relu` negative values become 0 (NaN
#: passes).
#:
#: Each array comes with the offset of its first number and the distance between its rows (0 repeats one row). The sums
#: run over `count` columns of a, `a_step` apart, and as many rows of b, in order and fused where the CPU can, so that
#: the bits do not depend on the blocks that a product is cut into.
product = _product(PRODUCT_ROWS, PRODUCT_VECTORS)
#: The same of WIDE columns.
narrow_product = _product(PRODUCT_ROWS, 1)


@_intrinsic
def sqrt(typingctx: Any, a: Any) -> Any:
    """Square root per lane."""
    if not _same(a):
        return None
    return a(a), lambda context, builder, sig, args: _call(builder, "sqrt", args)


#: Minimax fit of 2**f, |f| <= 1/2, lowest power first: relative error 7.5e-8 before rounding.
_EXP2 = (1.00000012, 0.693146944, 0.240221202, 0.0555071309, 0.00967554096, 0.00132764701)
#: Adding it to a float32 of magnitude below 2**22 rounds that to an integer, in the lowest bits of the sum.
_ROUND = 1.5 * 2.0**23


@_intrinsic
def exp2(typingctx: Any, x: Any) -> Any:
    """2**x of float32 for -126 < x < 127, relative error < 2e-7: exponent bits of round(x), polynomial for the rest."""
    if not isinstance(x, Lanes) or x.scalar != types.float32:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind, integers = args[0].type, ir.VectorType(ir.IntType(32), x.count)
        shifted = builder.fadd(args[0], _constant(kind, _ROUND))
        fraction = builder.fsub(args[0], builder.fsub(shifted, _constant(kind, _ROUND)))
        value = _constant(kind, _EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            value = _call(builder, "fmuladd", [value, fraction, _constant(kind, coefficient)])
        exponent = builder.shl(builder.bitcast(shifted, integers), _constant(integers, 23))
        return builder.bitcast(builder.add(builder.bitcast(value, integers), exponent), kind)

    return x(x), codegen


@_intrinsic
def select_gt(typingctx: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Per lane: a > b ? yes : no (NaN gives no)."""
    if not _same(a, b, yes, no):
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return a(a, b, yes, no), codegen


@_intrinsic
def mask_gt(typingctx: Any, a: Any, b: Any) -> Any:
    """uint64 whose bit i is 1 where a > b in lane i (NaN gives 0)."""
    if not _same(a, b):
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        mask = builder.bitcast(builder.fcmp_ordered(">", args[0], args[1]), ir.IntType(a.count))
        return builder.zext(mask, ir.IntType(64))

    return types.uint64(a, b), codegen


#: Index of the lowest set bit of a uint64 that is not 0.
trailing_zeros: Any = numbers.trailing_zeros


def _sum_of(builder: Any, a: Any, b: Any, even: Sequence[int], odd: Sequence[int]) -> Any:
    """shuffle(a, b, even) + shuffle(a, b, odd), a tree step of a sum over lanes."""
    kind = ir.VectorType(ir.IntType(32), LANES)
    left, right = (builder.shuffle_vector(a, b, ir.Constant(kind, list(order))) for order in (even, odd))
    return builder.fadd(left, right)


@_intrinsic
def folded(typingctx: Any, a: Any) -> Any:
    """LANES lanes from WIDE: the first LANES plus the others, if there are any."""
    if not isinstance(a, Lanes) or a.count != WIDE:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if WIDE == LANES:
            return args[0]
        return _sum_of(builder, args[0], args[0], range(LANES), range(LANES, WIDE))

    return Lanes(a.scalar, LANES)(a), codegen


@_intrinsic
def totals(typingctx: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    """Sums eight vectors over their lanes into one vector, pairwise in one fixed order, so that results repeat."""
    if not _same(a, b, c, d, e, f, g, h) or a.count != LANES:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pairs = ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15])
        quads = ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15])
        halves = ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15])
        vectors = list(args)
        for even, odd in (pairs, quads, halves):
            vectors = [_sum_of(builder, x, y, even, odd) for x, y in zip(vectors[::2], vectors[1::2], strict=True)]
        return vectors[0]

    return a(*[a] * 8), codegen


@_intrinsic
def total(typingctx: Any, a: Any) -> Any:
    """The sum over LANES lanes, pairwise in one fixed order."""
    if not _same(a) or a.count != LANES:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = args[0]
        for half in (4, 2, 1):
            order = [(i + half) % LANES for i in range(LANES)]
            value = _sum_of(builder, value, value, range(LANES), order)
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return a.scalar(a), codegen


@_intrinsic
def copy(typingctx: Any, to: Any, to_at: Any, array: Any, at: Any, count: Any) -> Any:
    """flat to[to_at : to_at + count] = flat array[at : at + count]"""
    if not (_readable(to) and _readable(array) and to.dtype == array.dtype):
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointers = (_address(context, builder, sig.args[i], *args[i : i + 2]) for i in (0, 2))
        move: Any = cgutils.raw_memcpy
        move(builder, *pointers, args[4], array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(to, types.intp, array, types.intp, types.intp), codegen


@kernel()
def aligned(size: int, dtype: Any) -> np.ndarray:
    """`size` zeros from the start of a cache line: loading a WIDE vector that spans two lines takes twice as long."""
    array = np.zeros(size + CACHE_LINE, dtype)
    first = -array.ctypes.data % CACHE_LINE // array.itemsize
    return array[first : first + size]
