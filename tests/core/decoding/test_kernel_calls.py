"""What Python checks before a kernel is called, and that it declares what the header does."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.kernels import (
    INTEGER,
    REAL,
    VALUE_TYPES,
    Array,
    Kernel,
    Plane,
    Values,
    reads,
    reads_plane,
    reads_values,
    writes,
    writes_plane,
    writes_values,
)

HEADER = (Path(__file__).parents[3] / "core" / "kernels" / "lodestream.h").read_text()
CODE = re.sub(r"/\*.*?\*/", "", HEADER, flags=re.DOTALL)


class Parameter(NamedTuple):
    """One of a function in C."""

    ctype: str
    name: str


def parameter_of(text: str) -> Parameter:
    before, _, after = text.strip().rpartition(" ")
    return Parameter(before + " *" * after.count("*"), after.strip("*"))


def fields_of(text: str) -> list[Parameter]:
    """The fields of a struct: a declaration may have several names of one type."""
    fields = []
    for declaration in filter(None, map(str.strip, text.split(";"))):
        first, *others = map(str.strip, declaration.split(","))
        kind = first.rpartition(" ")[0]
        fields += [parameter_of(word) for word in (first, *(f"{kind} {other}" for other in others))]
    return fields


STRUCTS = {
    name: fields_of(text)
    for name, text in re.findall(r"^struct lode_(\w+) \{(.*?)^\};", CODE, flags=re.DOTALL | re.MULTILINE)
}


def prototypes() -> dict[str, list[Parameter]]:
    """The functions of the header that are kernels; the fields of a struct are in place of its pointer."""
    functions = {}
    for name, text in re.findall(r"LODE_API int64_t lode_(\w+)\((.*?)\);", CODE, flags=re.DOTALL):
        parameters = [parameter_of(word) for word in text.split(",")]
        if parameters[-1].ctype == f"const struct lode_{name} *":
            parameters = [*parameters[:-1], *STRUCTS[name]]
        functions[name] = parameters
    return functions


DECLARED = {kernel.name: kernel for kernel in vars(kernels).values() if isinstance(kernel, Kernel)}
CTYPES = {"int64_t": ctypes.c_int64, "double": ctypes.c_double}
ELEMENTS = {"float": "float32", "double": "float64", "uint8_t": "uint8", "bool": "bool"}


def test_each_function_of_the_header_is_declared_and_no_other() -> None:
    assert len(re.findall(r"\blode_\w+\(", CODE)) == len(prototypes()) + 2  # lode_sources, lode_runs_v3
    assert sorted(DECLARED) == sorted(prototypes())
    taken = {name for name, kernel in DECLARED.items() if kernel.plain < len(kernel.arguments)}
    assert taken == set(STRUCTS)


@pytest.mark.parametrize("name", sorted(prototypes()))
def test_what_is_passed_is_what_the_function_takes(name: str) -> None:
    parameters, kernel = prototypes()[name], DECLARED[name]
    taken: list[Any] = [ctypes.c_void_p if p.ctype.endswith("*") else CTYPES[p.ctype] for p in parameters]
    assert kernel.types == taken
    for argument in kernel.arguments:
        mine, parameters = parameters[: len(argument.types)], parameters[len(argument.types) :]
        if isinstance(argument, Array | Plane):
            pointer = mine[0]
            element = pointer.ctype.removeprefix("const ").removesuffix(" *")
            expected = ELEMENTS.get(element, element.removesuffix("_t"))
            assert argument.dtype == expected or (argument.dtype == bool and expected == "uint8"), pointer.name
            assert pointer.ctype.startswith("const ") != argument.written, pointer.name
        elif isinstance(argument, Values):
            assert mine[0].ctype == ("void *" if argument.written else "const void *"), mine[0].name
            assert mine[2].name == f"{mine[0].name}_type"


def test_constants_are_those_of_the_header() -> None:
    constants = dict(re.findall(r"#define LODE_(\w+) ([(\d].*)", CODE))
    assert constants
    for name, text in constants.items():
        if hasattr(kernels, name):
            assert getattr(kernels, name) == eval(text), name


def call(value: Any, declared: Any) -> tuple[Any, ...]:
    """What a kernel of one argument is given: its function is one that keeps it."""
    given: list[Any] = []

    class Kept:
        argtypes, restype = None, None

        def __call__(self, *arguments: Any) -> int:
            for argument in arguments:
                start = isinstance(argument, ctypes.Array)
                given.append(ctypes.addressof(argument) if start else argument)
            return 0

    kernel = Kernel("kept", declared)
    kernel._function = Kept()
    assert kernel(value) == 0
    return tuple(given)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(5, np.int32),
        np.zeros((2, 0), np.int32),
        np.zeros((3, 4), np.int32)[1:],
        np.int32(7) + np.zeros((), "i4"),
    ],
)
@pytest.mark.parametrize("written", [False, True])
def test_an_array_is_its_address_and_its_elements(array: NDArray[np.int32], written: bool) -> None:
    whole = np.asarray(array)
    assert call(whole, writes("i4") if written else reads("i4")) == (whole.ctypes.data, whole.size)
    assert call(read_only(whole.copy()), reads("i4"))[1] == whole.size


def test_dtypes_are_equal_whichever_object_says_so() -> None:
    same = np.dtype("i4", metadata={"another": "object"})
    array = np.zeros(3, same)
    assert array.dtype is not np.dtype("i4")
    assert call(array, writes("i4")) == (array.ctypes.data, 3)


def test_an_array_that_may_not_be_written_is_its_address_too() -> None:
    array = np.frombuffer(bytes(12), np.int32)
    assert call(array, reads("i4")) == (array.ctypes.data, 3)
    assert call(array.reshape(1, 3), reads_plane("i4")) == (array.ctypes.data, 1, 3, 3)


@pytest.mark.parametrize(
    ("cut", "shape", "pitch"),
    [
        (np.s_[:, :], (6, 8), 8),
        (np.s_[1:5, 2:5], (4, 3), 8),
        (np.s_[::2, :3], (3, 3), 16),
        (np.s_[:, 3:4], (6, 1), 8),
        (np.s_[::2, ::8], (3, 1), 16),
        (np.s_[2:3, 1:4], (1, 3), 3),
        (np.s_[4:3:-1, 1:4], (1, 3), 3),
        (np.s_[2:2, :], (0, 8), 8),
    ],
)
def test_a_plane_is_its_address_rows_columns_and_pitch(cut: Any, shape: tuple[int, int], pitch: int) -> None:
    plane = np.zeros((6, 8), np.int32)[cut]
    assert call(plane, writes_plane("i4")) == (plane.ctypes.data, *shape, pitch)


@pytest.mark.parametrize("number", range(len(VALUE_TYPES)))
def test_values_are_their_address_elements_and_the_number_of_their_type(number: int) -> None:
    array = np.zeros((2, 3), VALUE_TYPES[number])
    for declared in (reads_values(), writes_values()):
        assert call(array, declared) == (array.ctypes.data, 6, number)
    assert call(read_only(array), reads_values())[1:] == (6, number)


def test_numbers_are_passed_as_they_are() -> None:
    for integer in (0, -(2**63) + 1, 2**63 - 1, True, np.int64(-3), np.uint8(200)):
        assert call(integer, INTEGER) == (integer,)
    for real in (0.5, 3, np.float32(0.25)):
        assert call(real, REAL) == (real,)


def misaligned(dtype: str) -> NDArray[Any]:
    return np.frombuffer(bytearray(17), np.uint8)[1:].view(dtype)


WRONG: list[tuple[Any, Any, type[Exception], str]] = [
    (np.zeros(3, np.int64), reads("i4"), TypeError, "expected an array of int32, got one of int64"),
    (np.zeros(3, ">i4"), reads("i4"), TypeError, "expected an array of int32, got one of >i4"),
    (np.zeros((3, 3), np.uint32), reads_plane("i4"), TypeError, "expected an array of int32, got one of uint32"),
    (np.zeros((3, 3), np.int32)[:, 1:], reads("i4"), ValueError, "in one piece, got (3, 2) with strides (12, 4)"),
    (np.zeros(6, np.int32)[::2], writes("i4"), ValueError, "in one piece, got (3,) with strides (8,)"),
    (read_only(np.zeros(3, np.int32)), writes("i4"), ValueError, "got one that is read-only"),
    (read_only(np.zeros((3, 3), np.int32)), writes_plane("i4"), ValueError, "got one that is read-only"),
    (misaligned("i4"), reads("i4"), ValueError, "expected an aligned array"),
    (misaligned("i4").reshape(2, 2), reads_plane("i4"), ValueError, "expected an aligned array"),
    (np.zeros((3, 3), np.int32).T, reads_plane("i4"), ValueError, "side by side, got strides (4, 12)"),
    (np.zeros((3, 3), np.int32)[::-1], reads_plane("i4"), ValueError, "side by side, got strides (-12, 4)"),
    (np.zeros(3, np.int32), reads_plane("i4"), ValueError, "expected two axes, got shape (3,)"),
    (np.zeros(3, np.dtype([("a", "i4"), ("b", "i2")]))["a"].reshape(3, 1), reads_plane("i4"), ValueError, "aligned"),
    (np.zeros(3, ">f8"), reads_values(), TypeError, "expected an array of numbers in this machine's order, got one of"),
    (np.zeros(3, np.float16), writes_values(), TypeError, "in this machine's order, got one of float16"),
    (np.zeros(3, np.bool_), writes_values(), TypeError, "in this machine's order, got one of bool"),
    (read_only(np.zeros(3, np.uint8)), writes_values(), ValueError, "got one that is read-only"),
    (np.zeros((3, 3), np.uint8)[:, 1:], reads_values(), ValueError, "in one piece, got (3, 2) with strides (3, 1)"),
    (misaligned("f8"), reads_values(), ValueError, "expected an aligned array"),
    ([1, 2], reads_values(), TypeError, "expected an array, got list"),
    ([1, 2], reads("i4"), TypeError, "expected an array, got list"),
    (None, writes_plane("i4"), TypeError, "expected an array, got NoneType"),
    (2.0, INTEGER, TypeError, "'float' object cannot be interpreted as an integer"),
    (2**63, INTEGER, ValueError, "expected an integer of 64 bits, got 9223372036854775808"),
    (-(2**64), INTEGER, ValueError, "expected an integer of 64 bits, got -18446744073709551616"),
    ("many", REAL, ValueError, "could not convert string to float"),
]


@pytest.mark.parametrize(("value", "declared", "kind", "words"), WRONG)
def test_what_was_not_declared_never_gets_there(value: Any, declared: Any, kind: type[Exception], words: str) -> None:
    called = Kernel("wrong", INTEGER, declared)
    called._function = lambda *_: pytest.fail("it was called")
    with pytest.raises(kind, match=re.escape(words)) as caught:
        called(1, value)
    assert str(caught.value).startswith("wrong: argument 1: ")
    with pytest.raises(TypeError, match="wrong: expected 2 arguments, got 1"):
        called(1)


def test_a_function_is_kept_for_other_threads_only_once_its_types_are_declared(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = Kernel("kept", INTEGER)
    kept: list[Any] = []

    class Function:
        def __setattr__(self, name: str, value: Any) -> None:
            kept.append(kernel._function)  # what another thread would call now

        def __call__(self, *arguments: Any) -> int:
            return 0

    monkeypatch.setattr(kernels, "library", lambda: {"lode_kept": Function()})
    assert kernel(1) == 0
    assert kept == [None, None]
    assert isinstance(kernel._function, Function)


def test_a_refusal_of_the_kernel_is_an_error_with_what_it_was_given() -> None:
    field, model, data, state = np.zeros((3, 8), "u1"), np.zeros(9, "i4"), np.zeros(70, "u1"), np.zeros(4, "i8")
    with pytest.raises(
        ValueError, match=r"mask: lengths or places .*: 0, 1, 2, 0, 1, \(3, 8\), \(9,\), \(70,\), \(4,\)"
    ):
        kernels.mask(0, 1, 2, 0, 1, field, model, data, state)
