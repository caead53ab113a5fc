"""What is exported computes what torch computes, at sizes that it was not exported with."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rainstereo.apps.cli import main
from rainstereo.model import export
from rainstereo.model.networks import OnnxNetwork
from rainstereo.model.restore import Restorer
from tests.model.small_restorer import CONFIG, generator, picture, saved

onnx = pytest.importorskip("onnx", reason="onnx is not installed")
pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")

SHAPES = {
    "gate, shuffled pixels, patches": replace(
        CONFIG, output_gate=True, up_sampling="pixel_shuffle", patch=2, block="separable", activation="gelu"
    ),
    "the paper's layers": replace(CONFIG, normalisation="instance", output_residual=False, up_sampling="transposed"),
}

SIZES = ((64, 96), (75, 130), (33, 20), (1, 9))
"""Not 1 x 1: instance normalisation of a flat image divides rounding errors by each other."""


@pytest.mark.parametrize(
    "name", [n if i == 0 else pytest.param(n, marks=pytest.mark.slow) for i, n in enumerate(SHAPES)]
)
def test_onnx_equals_torch(tmp_path: Path, name: str) -> None:
    made = generator(SHAPES[name])
    path = tmp_path / "a.onnx"
    path.write_bytes(export.to_onnx(made))
    assert export.difference(made, path, SIZES) <= 1e-4
    network, images = OnnxNetwork(path), torch.rand(3, 3, 40, 52)
    with torch.inference_mode():
        assert float((network(images) - made(images)).abs().max()) <= 1e-4
    proto = onnx.load(str(path))
    assert next(o.version for o in proto.opset_import if o.domain == "") == export.OPSET
    assert (network.multiple, network.local) == (made.config.multiple, made.config.tiles_equal_frame)


def test_torch_exports_for_any_size() -> None:
    made = generator()
    program = torch.export.load(io.BytesIO(export.to_program(made))).module()
    for shape in ((1, 3, 64, 32), (2, 3, 16, 100)):
        images = torch.rand(shape)
        with torch.inference_mode():
            assert float((program(images) - made(images)).abs().max()) <= 1e-5


def test_the_command_exports_and_derain_runs_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights, target = saved(tmp_path / "own"), tmp_path / "a.onnx"
    assert main(["export", "--out", str(target), "--checkpoint", str(weights)]) == 0
    assert "ONNX Runtime differs by" in capsys.readouterr().out
    image = picture()
    by_torch = Restorer(weights, precision="float32", skip=False)(image)
    by_onnx = Restorer(target, skip=False, backend="onnx")(image)
    assert np.abs(by_torch.astype(int) - by_onnx).max() <= 1
    assert main(["export", "--out", str(tmp_path / "a.pb"), "--checkpoint", str(weights)]) == 2
    with pytest.raises(ValueError, match="needs a file"):
        Restorer(backend="onnx")
    (tmp_path / "bad.onnx").write_bytes(b"no graph")
    with pytest.raises(ValueError, match="no network that ONNX Runtime can run"):
        OnnxNetwork(tmp_path / "bad.onnx")
