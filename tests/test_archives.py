"""Files of torch that stand for more than their bytes, or for anything but tensors, are refused before they unpack."""

import io
import pickle
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
from strategies import memory_below

from pd4dgs_codec.archives import MAX_PICKLE, read_tensors
from pd4dgs_codec.errors import DataError

PROTO, STOP = b"\x80\x02", b"."


def text(value: str) -> bytes:
    return b"X" + len(value).to_bytes(4, "little") + value.encode()


def numbers(*values: int) -> bytes:
    """A tuple of one or two."""
    packed = b"".join(b"\x8a\x08" + value.to_bytes(8, "little", signed=True) for value in values)
    return packed + (b"\x85", b"\x86")[len(values) - 1]


def tensor(size: int | tuple, stride: int | tuple, count: int = 4, offset: int = 0) -> bytes:
    """The pickle of a tensor in a storage of `count` float32. size, stride: two numbers are those of two axes."""
    stored = b"(" + text("storage") + b"ctorch\nFloatStorage\n" + text("0") + text("cpu") + numbers(count)[:-1] + b"tQ"
    hooks = b"ccollections\nOrderedDict\n)R"
    size, stride = (v if isinstance(v, tuple) else (v,) for v in (size, stride))
    shape = b"K" + bytes([offset]) + numbers(*size) + numbers(*stride)
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + stored + shape + b"\x89" + hooks + b"tR"


def archive(data: bytes, method: int = zipfile.ZIP_STORED, storage: bytes = bytes(16)) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as made:
        made.writestr("a/data.pkl", PROTO + data + STOP)
        made.writestr("a/data/0", storage)
    return stream.getvalue()


def overlapping() -> bytes:
    """A storage that the central directory names 400 times."""
    raw = archive(b"}", storage=bytes(1 << 12))
    start, last, end = raw.index(b"PK\x01\x02"), raw.rindex(b"PK\x01\x02"), raw.index(b"PK\x05\x06")
    entries, tail = raw[start:last] + raw[last:end] * 400, bytearray(raw[end:])
    tail[8:10] = tail[10:12] = (401).to_bytes(2, "little")
    tail[12:16] = len(entries).to_bytes(4, "little")
    return raw[:start] + entries + bytes(tail)


def doubled(depth: int = 60) -> bytes:
    return b"]q\x00" + b"".join(b"](h%ch%ceq%c" % (i, i, i + 1) for i in range(depth))


REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "a tensor of 2^30 numbers and one": (lambda: archive(tensor(1 << 30, 0)), "beyond its storage"),
    "a tensor of 2^45 numbers": (lambda: archive(tensor(1 << 45, 0)), "beyond its storage"),
    **{
        f"a tensor {name}": (lambda of=of: archive(tensor(*of)), "beyond its storage")
        for name, of in {
            "of one number more": (5, 1), "that begins late": (4, 1, 4, 1), "of wide steps": (2, 4),
            "of fewer than none": (-1, 1), "of more axes than steps": ((2, 2), 1),
            "of 2^32 times nothing": ((1 << 32, 0), (0, 1)),
        }.items()
    },
    "many tensors of one storage": (
        lambda: archive(b"](" + tensor(1 << 12, 1, 1 << 12) * 200 + b"e", storage=bytes(1 << 14)), "more bytes than"
    ),
    "a storage that lies about its size": (lambda: archive(tensor(4, 1, 1 << 40)), "expected 1099511627776"),
    "a deflated storage": (
        lambda: archive(tensor(1 << 20, 1, 1 << 20), zipfile.ZIP_DEFLATED, bytes(1 << 22)), "is compressed"
    ),
    "a deflated pickle": (lambda: archive(b"]" * 1000, zipfile.ZIP_DEFLATED), "is compressed"),
    "a pickle of 2 MiB and one": (lambda: archive(b"}" * MAX_PICKLE), f"expected one of {MAX_PICKLE:,} bytes"),
    "lists that are one": (doubled, "uses an object twice"),
    "a list in itself": (lambda: b"]q\x00h\x00a", "uses an object twice"),
    "a text that stands for gigabytes": (lambda: b"](" + text("x" * 9999) + b"q\x00" + b"h\x00" * 999 + b"e", "twice"),
    "a tuple for a key": (lambda: b"}" + b"J\xff\xff\xff\xff" * 2 + b"\x86Ns", "neither a short"),
    "keys that make long names": (lambda: b"}" + text("x" * 999) + b"Ns", "neither a short"),
    "a number for a key of a common hash": (lambda: b"}" + numbers((1 << 61) - 1)[:-1] + b"Ns", "neither a short"),
    "members in pairs": (lambda: b"c__torch__.a\nb\n)\x81](" + text("x") + b"N\x86eb", "something other than a module"),
    "an operation that none needs": (lambda: b"(" + text("a") + b"l", "the operation LIST"),
    "a memo of 2^31 places": (lambda: b"]r\xff\xff\xff\x7f" * 3, "not a zip archive of tensors"),
    "code": (lambda: b"cos\nsystem\n" + text("true") + b"\x85R", "the pickle imports os.system"),
    "a number of numpy that holds objects": (lambda: b"cnumpy\ndtype\n(" + text("O8") + b"tR", "calls something other"),
    "a number of numpy without a kind": (
        lambda: b"cnumpy.core.multiarray\nscalar\n(N" + text("x") + b"tR", "calls something other"
    ),
    "a long text as bytes": (
        lambda: b"c_codecs\nencode\n(" + text("x" * 9) + text("latin1") + b"tR", "calls something other"
    ),
    "a text in another code": (lambda: b"c_codecs\nencode\n(" + text("x") + text("zip") + b"tR", "something other"),
    "a class of code": (lambda: b"cbuiltins\neval\n)\x81", "the pickle imports builtins.eval"),
    "an end in the middle": (lambda: b"t", "not a zip archive of tensors"),
    "overlapping members": (overlapping, "refused: members overlap"),
    "nothing": (lambda: b"", "not a zip archive of tensors"),
    "an archive of another kind": (lambda: archive(b"}").replace(b"a/data.pkl", b"a/read.txt"), "0 members NAME/data"),
    "an endless number": (lambda: b"\x8b" + (1 << 16).to_bytes(4, "little") + b"\x7f" * (1 << 16), "operation LONG4"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_costs_more_than_it_weighs_is_refused(name):
    make, says = REFUSED[name]
    raw = make()
    raw = raw if raw.startswith(b"PK") else archive(raw)
    with memory_below(8 * len(raw) + (1 << 21)), pytest.raises(DataError, match=says) as caught:
        read_tensors(raw, "m.pt")
    assert str(caught.value).startswith("m.pt: ") and str(caught.value).isprintable()


def test_deep_and_wide_content_is_read_in_one_pass():
    found = read_tensors(archive(b"](" * 3000 + b"e" * 2999 + b"e"), "m.pt")
    depth = 0
    while found:
        found, depth = found[0], depth + 1
    assert depth == 2999
    wide = {f"key {i}": (i, 1.5, None, True, [i]) for i in range(3000)}
    assert read_tensors(archive(pickle.dumps(wide, 2)[2:-1]), "m.pt") == wide


@pytest.mark.parametrize("core", [b"core", b"_core"])
def test_single_numbers_of_numpy_are_read(core):
    """As trainers leave them in checkpoints; numpy 2 has renamed their module."""
    values = {"rate": np.float64(0.1), "radius": np.float32(1.5), "step": np.int64(-3), "again": np.float64(2)}
    data = pickle.dumps(values, 2)[2:-1].replace(b"numpy._core.", b"numpy." + core + b".")
    found = read_tensors(archive(data), "m.pt")
    assert found == {name: value.item() for name, value in values.items()} and type(found["step"]) is int


def test_tensors_are_views_of_the_file():
    found = read_tensors(archive(tensor(2, 2), storage=np.arange(4, dtype="<f4").tobytes()), "m.pt")
    np.testing.assert_array_equal(found, [0.0, 2.0])
    assert not found.flags.writeable


def test_tensors_equal_those_written_by_torch(tmp_path):
    torch = pytest.importorskip("torch")
    base = torch.arange(24.0).reshape(4, 6)
    tensors = {"whole": base, "turned": base.T, "part": base[1:3, 2:4], "long": torch.tensor([3, 4]), "none": base[:0]}
    tensors |= {"double": base.double(), "half": base.half(), "scalar": base[2, 3], "own": torch.nn.Parameter(base)}
    torch.save({"a": tensors, "b": [1, "x", None]}, tmp_path / "t.pth")
    found = read_tensors((tmp_path / "t.pth").read_bytes(), "t.pth")
    assert found["b"] == [1, "x", None]
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(found["a"][name], tensor.detach().numpy(), err_msg=name)
        assert found["a"][name].dtype == tensor.detach().numpy().dtype
