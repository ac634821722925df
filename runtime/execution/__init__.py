"""ONNX graphs, run."""
