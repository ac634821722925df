"""A decoder's graph with its table built in: what follows from the table alone is then computed once, on load.

ONNX Runtime folds constants, but not defaults of inputs that may be fed. So the graph is opened with fewer inputs.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import BundleError
from runtime.execution.session import Port
from runtime.pb.lightpage.onnx import graph_pb2 as pb

_DTYPES = {1: "float32", 2: "uint8", 4: "uint16", 6: "int32", 7: "int64", 11: "float64"}
"""numpy's names of ONNX's element types."""
_LISTS = {"float32": "float_data", "int64": "int64_data", "float64": "double_data"}
"""Where values lie that are not stored as bytes, by type; those of all other types share a list."""
_DEFAULTS_FROM = 4
"""Version of ONNX's representation from which an input may have a default; before, weights are listed as inputs too."""


class GraphFile:
    """The bytes of an ONNX file, so far as its inputs and their defaults are concerned.

    Args:
        model: the serialised model.
        subject: what it is, for the error.

    Attributes:
        table_inputs: inputs that have a default, by name, of its type and shape.

    Raises:
        BundleError: the bytes are no ONNX model.
    """

    def __init__(self, model: bytes, subject: str) -> None:
        self._model = model
        expected = "an ONNX model of a Lightpage bundle"
        try:
            whole = pb.Model.FromString(model)
        except DecodeError as error:
            raise BundleError(subject, error, expected) from None
        if not whole.HasField("graph"):
            raise BundleError(subject, "no graph", expected)
        fed = {entry.name for entry in whole.graph.input} if whole.ir_version >= _DEFAULTS_FROM else set()
        self.table_inputs = {
            tensor.name: Port(_DTYPES.get(tensor.data_type, str(tensor.data_type)), tuple(tensor.dims))
            for tensor in whole.graph.initializer
            if tensor.name in fed
        }

    def default(self, name: str) -> NDArray[np.generic]:
        """The default of a table input, read-only.

        Args:
            name: one of `table_inputs`.
        """
        graph = pb.Model.FromString(self._model).graph
        tensor = next(tensor for tensor in graph.initializer if tensor.name == name)
        port = self.table_inputs[name]
        dtype = np.dtype(port.dtype)
        if tensor.raw_data:
            values = np.frombuffer(tensor.raw_data, dtype.newbyteorder("<")).astype(dtype, copy=False)
        else:
            values = np.array(getattr(tensor, _LISTS.get(port.dtype, "int32_data")), dtype)
        return values.reshape([int(size) for size in tensor.dims])

    def built_in(self, table: SamplingTable, fed: Collection[str]) -> bytes:
        """The model without table inputs but those `fed`.

        Args:
            table: values instead of the defaults, of their types and shapes.
            fed: names of table inputs that stay inputs, their defaults as they are.
        """
        model = pb.Model.FromString(self._model)
        inputs = [entry for entry in model.graph.input if entry.name in fed or entry.name not in self.table_inputs]
        del model.graph.input[:]
        model.graph.input.extend(inputs)
        for tensor in model.graph.initializer:
            if tensor.name in table and tensor.name not in fed:
                for field in ("float_data", "int32_data", "int64_data", "double_data", "uint64_data"):
                    tensor.ClearField(field)
                value = np.asarray(table[tensor.name])
                tensor.raw_data = value.astype(value.dtype.newbyteorder("<")).tobytes()
        return model.SerializeToString()
