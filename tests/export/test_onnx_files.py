"""What ONNX files hold, and what they hold once."""

from __future__ import annotations

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn

from export.onnx_files import _export
from runtime.execution.session import open_session


class TwoWays(nn.Module):
    """Products with three matrices, two of which are alike."""

    def __init__(self) -> None:
        super().__init__()
        rng = torch.Generator().manual_seed(0)
        large, other = torch.rand(40, 40, generator=rng), torch.rand(40, 40, generator=rng)
        for name, value in (("there", large), ("back", large.clone()), ("other", other)):
            self.register_buffer(name, value)

    def forward(self, light: torch.Tensor) -> torch.Tensor:
        """Through all three."""
        return light @ self.there @ self.other @ self.back


def test_a_large_constant_is_kept_once_and_the_answer_is_the_same() -> None:
    module, light = TwoWays(), torch.eye(40)
    model = _export(module, (light,), ("light",), ("seen",), None)
    onnx.checker.check_model(model)
    held = [numpy_helper.to_array(one) for one in model.graph.initializer if np.prod(one.dims) == 1600]
    assert len(held) == 2
    assert not np.array_equal(*held)
    (seen,) = open_session(model.SerializeToString(), "two ways", 1).run(["seen"], {"light": light.numpy()})
    np.testing.assert_allclose(seen, module(light).numpy(), rtol=1e-5)
