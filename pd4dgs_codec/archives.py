"""Reads tensors from torch and TorchScript files as data, without calling anything that a file names.

Both formats are zip archives with a pickle `data.pkl` and one member per storage. `_Machine` implements only the pickle
operations and globals that such files need, and refuses all others. Memory and time are linear in the size of the file:
members must be uncompressed, tensors hold no more bytes than the file, each list, dict and tensor is used once, and
keys are short strings or small numbers. `torch.load(weights_only=True)` has none of these bounds and refuses
TorchScript.
"""

import io
import math
import pickletools
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pd4dgs_codec.errors import DataError, one_line

#: numpy dtypes by torch's name of the storage class.
STORAGES = dict(
    FloatStorage="<f4", DoubleStorage="<f8", HalfStorage="<f2", LongStorage="<i8", IntStorage="<i4", ShortStorage="<i2",
    CharStorage="i1", ByteStorage="u1", BoolStorage="?",
)  # fmt: skip
MAX_PICKLE = 1 << 21  #: bytes of data.pkl
SHORT, FEW = 256, 4  #: most characters of a key and of a reused string; most items of a reused tuple
MAX_KEY = 1 << 31  #: of numbers as keys: multiples of 2^61 - 1 share a hash, and a dict of them takes quadratic time
VALUES = {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE"}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class Name(NamedTuple):
    """A global that a pickle names, such as a class."""

    module: str
    name: str


class Module:
    """A module of a TorchScript file. kind: the name of its class. members: values by name."""

    def __init__(self, kind: str):
        self.kind, self.members = kind, dict[str, Any]()


class Refused(Exception):
    """The file holds something other than tensors, or more data than its own size."""


ORDERED = Name("collections", "OrderedDict")
#: What pickles of numpy's single numbers call: a dtype, bytes from text, and a number from both.
DTYPE, BYTES = Name("numpy", "dtype"), Name("_codecs", "encode")
NUMBERS = [Name(f"numpy.{core}.multiarray", "scalar") for core in ("core", "_core")]
TENSOR, PARAMETER = Name("torch._utils", "_rebuild_tensor_v2"), Name("torch._utils", "_rebuild_parameter")


def read_tensors(raw: bytes, where: str, made: Callable[[np.ndarray], Any] = lambda array: array) -> Any:
    """Returns the content of a file: dicts, lists, tuples, scalars, Modules, and `made(array)` for each tensor.

    made: takes a read-only array. Raises DataError, whose message begins with `where`, for any other file.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            return _Machine(archive, len(raw), made).result
    except Refused as error:
        raise DataError(f"{where}: refused: {error}; expected tensors alone") from None
    except Exception as error:  # zipfile, pickletools and a broken pickle raise many kinds
        reason = one_line(f"{type(error).__name__}: {error}", 120)
        cut = isinstance(error, zipfile.BadZipFile) and raw.startswith(b"PK")
        what = "damaged or cut short" if cut else "not a zip archive of tensors as torch writes it"
        raise DataError(f"{where}: {what} ({reason})") from None


class _Machine:
    """Runs the pickle of an archive of `size` bytes and stores the value that it builds in `result`."""

    def __init__(self, archive: zipfile.ZipFile, size: int, made: Callable[[np.ndarray], Any]):
        members = archive.infolist()
        if sum(member.compress_size for member in members) > size:
            raise Refused("members overlap")
        pickles = [member for member in members if member.filename.split("/")[1:] == ["data.pkl"]]
        if len(pickles) != 1 or pickles[0].file_size > MAX_PICKLE:
            raise Refused(f"{len(pickles)} members NAME/data.pkl, expected one of {MAX_PICKLE:,} bytes at most")
        self.archive, self.size, self.left, self.made = archive, size, size, made
        self.prefix = pickles[0].filename.removesuffix("data.pkl")
        if f"{self.prefix}byteorder" in archive.NameToInfo and self._read("byteorder") != b"little":
            raise Refused("numbers that are not little-endian")
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.storages: dict[str, bytes] = {}
        for operation, argument, _ in pickletools.genops(self._read("data.pkl")):
            self._step(operation.name, argument)
        (self.result,) = self.stack

    def _read(self, name: str) -> bytes:
        """Returns the bytes of a member. Refuses a compressed member, which torch never writes."""
        member = self.archive.getinfo(f"{self.prefix}{name}")
        if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
            raise Refused(f"member {name!r} is compressed")
        return self.archive.read(member)

    def _step(self, name: str, argument: Any) -> None:
        stack = self.stack
        if name in VALUES:
            stack.append(argument)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self.memo[len(self.memo) if name == "MEMOIZE" else argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(_again(self.memo[argument]))
        elif name == "MARK":
            self.marks.append(len(stack))
        elif name in ("EMPTY_DICT", "EMPTY_LIST"):
            stack.append({} if name == "EMPTY_DICT" else [])
        elif name == "TUPLE" or name in TUPLES:
            stack.append(tuple(self._taken(TUPLES.get(name))))
        elif name in ("SETITEM", "SETITEMS"):
            _set(self._taken(2 if name == "SETITEM" else None), stack[-1])
        elif name in ("APPEND", "APPENDS"):
            items = self._taken(1 if name == "APPEND" else None)
            list.extend(stack[-1], items)
        elif name in ("GLOBAL", "STACK_GLOBAL"):
            stack.append(_known(*(argument.split(" ", 1) if name == "GLOBAL" else self._taken(2))))
        elif name == "BINPERSID":
            stack.append(self._storage(*stack.pop()))
        elif name in ("REDUCE", "NEWOBJ"):
            stack.append(self._call(*self._taken(2)))
        elif name == "BUILD":
            self._build(*self._taken(1))
        elif name not in ("PROTO", "FRAME", "STOP"):
            raise Refused(f"the pickle uses the operation {name}")

    def _taken(self, count: int | None) -> list[Any]:
        """Pops the last `count` values of the stack, or all values since the last mark if `count` is None."""
        start = self.marks.pop() if count is None else len(self.stack) - count
        if start < 0:
            raise Refused("the pickle is truncated")
        values = self.stack[start:]
        del self.stack[start:]
        return values

    def _storage(self, kind: Any, dtype: Any, key: Any, _: Any, count: Any) -> np.ndarray:
        """Returns a storage as a 1-D array; reads its member at first use."""
        if kind != "storage" or not isinstance(dtype, np.dtype) or not str(key).isdigit():
            raise Refused("a storage of an unknown kind")
        if key not in self.storages:
            self.storages[key] = self._read(f"data/{key}")
        values = np.frombuffer(self.storages[key], dtype)
        if len(values) != count:
            raise Refused(f"a storage of {len(values)} numbers, expected {one_line(str(count), 24)}")
        return values

    def _call(self, what: Any, values: Any) -> Any:
        if what == ORDERED and values == ():
            return {}
        if what == TENSOR:
            return self._tensor(*values)
        if what == PARAMETER:
            return values[0]
        if what == DTYPE and values[0] in ("f4", "f8", "i4", "i8"):
            return np.dtype(f"<{values[0]}")
        if what == BYTES and values[1:] == ("latin1",) and len(values[0]) <= 8:
            return values[0].encode("latin1")
        if what in NUMBERS and isinstance(values[0], np.dtype):
            return np.frombuffer(values[1], values[0], 1)[0].item()
        if isinstance(what, Name) and what.module.startswith("__torch__."):
            return Module(what.name)
        raise Refused("the pickle calls something other than a class of tensors or modules")

    def _build(self, state: Any) -> None:
        """Sets the members of a module. Ignores those of an OrderedDict, torch's own metadata, and of a dtype."""
        if isinstance(self.stack[-1], Module) and isinstance(state, dict):
            self.stack[-1].members.update(state)
        elif not isinstance(self.stack[-1], (dict, np.dtype)):
            raise Refused("the pickle sets the state of something other than a module")

    def _tensor(self, storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> Any:
        """Returns `made` of a view of the storage."""
        whole = all(type(v) is int and v >= 0 for v in (offset, *size, *stride)) and len(size) == len(stride)
        count = math.prod(size) if whole else -1
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True)) if whole and count else offset
        # each axis is bounded even if another is empty: a caller may allocate an array of its length
        if not whole or count > len(storage) or (count and last >= len(storage)) or max(size, default=0) > self.size:
            raise Refused("a tensor extends beyond its storage")
        self.left -= count * storage.itemsize
        if self.left < 0:
            raise Refused("the tensors take more bytes than the file")
        strides = tuple(step * storage.itemsize for step in stride)
        return self.made(np.lib.stride_tricks.as_strided(storage[offset:], tuple(size), strides, writeable=False))


def _known(module: str, name: str) -> Any:
    """Returns the dtype or Name of a global that tensor files need; refuses any other."""
    if module == "torch" and name in STORAGES:
        return np.dtype(STORAGES[name])
    found = Name(module, name)
    if found not in (ORDERED, TENSOR, PARAMETER, DTYPE, BYTES, *NUMBERS) and not module.startswith("__torch__."):
        raise Refused(f"the pickle imports {one_line(f'{module}.{name}', 80)}")
    return found


def _again(value: Any) -> Any:
    """Returns a reused value: a number, name, short string or short tuple. Others could turn few bytes to gigabytes."""
    parts = value if isinstance(value, tuple) and len(value) <= FEW else (value,)
    if not all(isinstance(v, (int, float, np.dtype)) or isinstance(v, str) and len(v) <= SHORT for v in parts):
        raise Refused("the pickle uses an object twice")
    return value


def _set(items: list[Any], target: Any) -> None:
    if not isinstance(target, dict) or len(items) % 2:
        raise Refused("the pickle sets items of something other than a dict")
    for key in items[::2]:
        if not (isinstance(key, str) and len(key) <= SHORT or isinstance(key, int) and abs(key) <= MAX_KEY):
            raise Refused(f"a key is neither a short string nor a number: {one_line(repr(key), 60)}")
    target.update(zip(items[::2], items[1::2], strict=True))
