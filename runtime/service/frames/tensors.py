"""Tensors and parameters of the Open Inference Protocol: requests to arrays, a decoded page to tensors."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.wire.messages import enum_name

RAW_TYPES = {
    "BOOL": np.dtype(np.bool_),
    "UINT8": np.dtype(np.uint8),
    "UINT16": np.dtype("<u2"),
    "FP32": np.dtype("<f4"),
}
"""Of elements, row-major."""
_TYPED_FIELDS = {"BOOL": "bool_contents", "UINT8": "uint_contents", "UINT16": "uint_contents"}
_SLICE = 1 << 16
"""Typed elements that are taken at a time: the interpreter does nothing else meanwhile."""
_LARGEST_COUNT = (1 << 32) - 1
"""Of a parameter: the fields that parameters stand for have 32 bits."""
_PARAMETERS: dict[type, str] = {bool: "bool_param", int: "int64_param", float: "double_param", str: "string_param"}
"""Field of a parameter by the kind of its value."""
_FEW = 8
"""Names or dimensions of a caller's that an error lists."""
_TYPED_BYTES = {"bool_contents": 1, "uint_contents": 4}
_ANY_BYTES = 16
"""Memory of a typed element, once parsed; of kinds that no input has, at most."""

Request = oip.ModelInferRequest
Input = oip.ModelInferRequest.InferInputTensor


@dataclass(frozen=True)
class Tensor:
    """An input of the model.

    Attributes:
        datatype: one of `RAW_TYPES`.
        shape: shape of the input.
        wrong: class of the error where another one comes.
        optional: whether it may be left out.
    """

    datatype: str
    shape: tuple[int, ...]
    wrong: type[InvalidInputError]
    optional: bool = False

    def __str__(self) -> str:
        return _told(self.datatype, self.shape)


def inputs_of(request: Request, raw: Sequence[memoryview], expected: Mapping[str, Tensor]) -> dict[str, NDArray[Any]]:
    """The input tensors by name; those with raw contents are views of these, which cannot be written to.

    Args:
        request: request that came.
        raw: its raw contents.
        expected: what the model takes, by name.

    Raises:
        InvalidInputError: a tensor that is missing, unknown, or there twice, of another type, shape or size, or with
            contents in two forms; of the class `Tensor.wrong` where that is known.
    """
    names = set[str]()
    for tensor in request.inputs:
        _check(tensor, expected)
        if tensor.name in names:
            raise InvalidInputError(f"inputs.{tensor.name}", "this tensor twice", "once")
        names.add(tensor.name)
    for name, known in expected.items():
        if name not in names and not known.optional:
            raise InvalidInputError(f"inputs.{name}", "nothing", known)
    if not raw:
        return {tensor.name: _typed(tensor, expected[tensor.name]) for tensor in request.inputs}
    for tensor in request.inputs:
        if tensor.HasField("contents"):
            subject = f"inputs.{tensor.name}.contents"
            raise InvalidInputError(subject, "typed contents beside raw_input_contents", "one of the two")
    if len(raw) != len(request.inputs):
        raise InvalidInputError("raw_input_contents", f"{len(raw)} of them", f"{len(request.inputs)}, one an input")
    pairs = zip(request.inputs, raw, strict=True)
    return {tensor.name: _raw(tensor, content, expected[tensor.name]) for tensor, content in pairs}


def _check(tensor: Input, expected: Mapping[str, Tensor]) -> None:
    """Check all of a tensor but its contents."""
    known, subject = expected.get(tensor.name), f"inputs.{tensor.name}"
    if known is None:
        raise InvalidInputError("inputs", repr(tensor.name), f"one of {', '.join(expected)}")
    if tensor.parameters:
        raise InvalidInputError(f"{subject}.parameters", _few(tensor.parameters, len(tensor.parameters)), "none")
    if tensor.datatype != known.datatype or len(tensor.shape) != len(known.shape) or tuple(tensor.shape) != known.shape:
        raise known.wrong(subject, _told(tensor.datatype, tensor.shape), known)


def _raw(tensor: Input, content: memoryview, known: Tensor) -> NDArray[Any]:
    subject = f"inputs.{tensor.name}"
    dtype, count = RAW_TYPES[known.datatype], int(np.prod(known.shape))
    if len(content) != count * dtype.itemsize:
        raise known.wrong(subject, f"{len(content)} bytes", f"{count * dtype.itemsize} bytes of {known}")
    if dtype == np.bool_:
        flags = np.frombuffer(content, np.uint8)
        if int(flags.max(initial=0)) > 1:
            raise known.wrong(subject, f"a flag of {flags.max()}", "flags of 0 or 1")
    array = np.frombuffer(content, dtype).astype(dtype.newbyteorder("="), copy=False)
    return np.require(array, requirements="A").reshape(known.shape)


def _typed(tensor: Input, known: Tensor) -> NDArray[Any]:
    subject, field = f"inputs.{tensor.name}.contents", _TYPED_FIELDS[known.datatype]
    count = int(np.prod(known.shape))
    others = sorted(each.name for each, _ in tensor.contents.ListFields() if each.name != field)
    if others:
        raise known.wrong(subject, ", ".join(others), f"{field} alone")
    values = getattr(tensor.contents, field)
    if len(values) != count:
        raise known.wrong(f"{subject}.{field}", f"{len(values)} elements", f"{count} of {known}")
    array = np.empty(count, RAW_TYPES[known.datatype].newbyteorder("="))
    for start in range(0, count, _SLICE):
        part = np.array(values[start : start + _SLICE])
        if array.dtype != np.bool_ and int(part.max()) > (largest := np.iinfo(array.dtype).max):
            raise known.wrong(f"{subject}.{field}", f"an element of {part.max()}", f"0..{largest}")
        array[start : start + _SLICE] = part
    return array.reshape(known.shape)


def typed_bytes(request: Request) -> int:
    """Memory of all typed contents of a request, once they are parsed."""
    lists = (each for tensor in request.inputs for each in tensor.contents.ListFields())
    return sum(len(values) * _TYPED_BYTES.get(field.name, _ANY_BYTES) for field, values in lists)


def parameters_of(request: Request, kinds: Mapping[str, type]) -> dict[str, Any]:
    """The parameters of a request by name.

    Args:
        request: request that came.
        kinds: int, str or bool, by name.

    Raises:
        InvalidInputError: one that is not known, of another type, or a number that is no count.
    """
    found: dict[str, Any] = {}
    for name, parameter in request.parameters.items():
        if (kind := kinds.get(name)) is None:
            raise InvalidInputError("parameters", repr(name), f"one of {', '.join(kinds)}")
        choice = parameter.WhichOneof("parameter_choice")
        value: Any = None if choice is None else getattr(parameter, choice)
        if type(value) is not kind:
            raise InvalidInputError(f"parameters.{name}", choice or "no value", _PARAMETERS[kind])
        found[name] = value
        if kind is int and not 0 <= found[name] <= _LARGEST_COUNT:
            raise InvalidInputError(f"parameters.{name}", value, f"0..{_LARGEST_COUNT}")
    return found


def outputs_of(request: Request, known: Collection[str], usual: Sequence[str]) -> Sequence[str]:
    """Names of the outputs that a request asks for, `usual` where it names none.

    Raises:
        InvalidInputError: one that is not known, there twice, or with parameters.
    """
    names = [output.name for output in request.outputs]
    for index, output in enumerate(request.outputs):
        if output.name not in known:
            raise InvalidInputError("outputs", repr(output.name), f"one of {', '.join(known)}")
        if output.name in names[:index]:
            raise InvalidInputError(f"outputs.{output.name}", "this tensor twice", "once")
        if output.parameters:
            got = _few(output.parameters, len(output.parameters))
            raise InvalidInputError(f"outputs.{output.name}.parameters", got, "none")
    return names or usual


def parameters_message(message: Any, left_out: Collection[str] = (), prefix: str = "") -> dict[str, oip.InferParameter]:
    """All that a message says as parameters: `name`, or `outer.name` of a message in it.

    Bytes are left out, and so are messages that are not set. A name of an enum is without its prefix; names or
    numbers in a list are separated by commas.
    """
    found: dict[str, oip.InferParameter] = {}
    for field in message.DESCRIPTOR.fields:
        if field.name in left_out or field.type == FieldDescriptor.TYPE_BYTES:
            continue
        name, value = f"{prefix}{field.name}", getattr(message, field.name)
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            if message.HasField(field.name):
                found |= parameters_message(value, left_out, f"{name}.")
        elif field.enum_type is not None:
            names = [enum_name(field.enum_type, each) for each in (value if field.is_repeated else [value])]
            found[name] = oip.InferParameter(string_param=",".join(names).replace("UNSPECIFIED", ""))
        elif field.is_repeated:
            found[name] = oip.InferParameter(string_param=",".join(map(str, value)))
        else:
            found[name] = oip.InferParameter(**{_PARAMETERS[type(value)]: value})
    return found


def _told(datatype: str, shape: Sequence[int]) -> str:
    return f"{datatype} [{_few(map(str, shape[:_FEW]), len(shape))}]"


def _few(names: Iterable[str], count: int) -> str:
    """A list for an error, of which a caller may have sent any number."""
    told = ", ".join(islice(names, _FEW))
    return told if count <= _FEW else f"{told} and {count - _FEW} more"
