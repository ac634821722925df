"""Torch to ONNX: graph, bundle, parity."""
