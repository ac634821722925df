"""The model: a bundle, the runtime that executes its graphs, and the decoder that reads a page with them.

`bundle` opens and writes bundles, `execution` runs ONNX graphs on a provider, `decoding` turns a frame pair into
symbols and follows the image while the device drifts. This room imports nothing else of `lightpage.runtime`.
"""
