"""Tensors from files of torch, pickles and TorchScript, without running any code of theirs.

Both are zip archives with a pickle `data.pkl` and one member per storage. The unpickler knows a handful of names and
refuses all others. Classes of TorchScript become `Module` with their members; their code is not read.
`torch.load(weights_only=True)` refuses TorchScript.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.files import read_file
from pd4dgs_codec.errors import DataError, one_line

#: Torch's names of storages and what they hold.
STORAGES = dict(FloatStorage="<f4", DoubleStorage="<f8", HalfStorage="<f2", LongStorage="<i8", IntStorage="<i4")
MAX_PICKLE = 1 << 24  #: bytes of data.pkl


class Module:
    """A module of a TorchScript file, with its members as attributes; the class has the name in the file."""


class Refused(Exception):
    """A pickle names something else than tensors."""


def read_tensors(path: Path) -> Any:
    """The content of a file: dicts, lists, scalars, modules, and tensors as numpy arrays. Raises DataError."""
    raw = read_file(path)
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            return _content(archive)
    except Refused as error:
        raise DataError(f"{path}: refused: {error}; expected tensors alone") from None
    except Exception as error:  # zipfile and pickle raise many kinds for what is broken
        reason = one_line(f"{type(error).__name__}: {error}", 120)
        raise DataError(f"{path}: not a zip archive of tensors as torch writes it ({reason})") from None


def _content(archive: zipfile.ZipFile) -> Any:
    members = {member.filename: member for member in archive.infolist()}
    pickles = [name for name in members if name.split("/")[1:] == ["data.pkl"]]
    if len(pickles) != 1:
        raise Refused(f"{len(pickles)} members NAME/data.pkl, where there must be one")
    size = members[pickles[0]].file_size
    if size > MAX_PICKLE:
        raise Refused(f"a pickle of {size} bytes, more than {MAX_PICKLE}")
    prefix = pickles[0].removesuffix("data.pkl")
    if f"{prefix}byteorder" in members and _read(archive, f"{prefix}byteorder") != b"little":
        raise Refused("numbers that are not little-endian")
    return _Unpickler(_read(archive, pickles[0]), lambda key: _read(archive, f"{prefix}data/{key}")).load()


def _read(archive: zipfile.ZipFile, name: str) -> bytes:
    """The bytes of a member. torch does not compress them, so none may grow when read."""
    if archive.getinfo(name).compress_type != zipfile.ZIP_STORED:
        raise Refused(f"member {name!r} is compressed")
    return archive.read(name)


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, storage: Callable[[str], bytes]):
        super().__init__(io.BytesIO(data))
        self._storage = lru_cache(maxsize=None)(storage)

    def find_class(self, module: str, name: str) -> Any:
        """The names that files of tensors need; all others are refused."""
        if module.startswith("__torch__."):
            return type(name, (Module,), {})
        if module == "torch" and name in STORAGES:
            return np.dtype(STORAGES[name])
        known = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): lambda data, *_: data,
        }
        if (module, name) not in known:
            raise Refused(f"the pickle asks for {one_line(f'{module}.{name}', 80)}")
        return known[module, name]

    def persistent_load(self, pid: Any) -> np.ndarray:
        """A storage as a 1-D array."""
        kind, dtype, key, _, count = pid
        if kind != "storage" or not isinstance(dtype, np.dtype) or not str(key).isdigit():
            raise Refused("a storage of an unknown kind")
        values = np.frombuffer(self._storage(str(key)), dtype)
        if len(values) != count:
            raise Refused(f"a storage of {len(values)} numbers that should hold {count}")
        return values


def _tensor(storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> np.ndarray:
    """A tensor as a view of its storage, so that tensors that share one take no more memory."""
    whole = all(type(v) is int and v >= 0 for v in (offset, *size, *stride)) and len(size) == len(stride)
    count = int(np.prod([int(v) for v in size], dtype=object)) if whole else -1
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True)) if whole and count > 0 else offset
    if not whole or count > len(storage) or (count > 0 and last >= len(storage)):
        raise Refused("a tensor that reaches beyond its storage")
    strides = tuple(step * storage.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(storage[offset:], tuple(size), strides, writeable=False)
