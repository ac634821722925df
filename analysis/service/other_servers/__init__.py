"""The service beside MLServer, KServe and Ray Serve that carry the very same ONNX graphs.

`python -m analysis.service.other_servers --help` says what is measured, and how.
"""
