"""gRPC: server and servicer."""
