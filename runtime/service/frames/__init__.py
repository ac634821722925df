"""Frames that callers send: they are received, decoded, and answered, by gRPC or the Open Inference Protocol."""
