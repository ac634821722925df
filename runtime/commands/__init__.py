"""Subcommands of `lightpage` that need no torch."""

import os

# Read when gRPC is imported. Without it, each stranger whose handshake fails writes a line to a service's stderr.
os.environ.setdefault("GRPC_VERBOSITY", "ERROR")
