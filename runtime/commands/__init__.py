"""Subcommands of `lightpage` that need no torch: they read options, call other rooms, and alone know of terminals.

`archives` works on files, `client` talks to a running service, `service` runs one. This room imports all others.
"""

import os

# Read when gRPC is imported. Without it, each stranger whose handshake fails writes a line to a service's stderr.
os.environ.setdefault("GRPC_VERBOSITY", "ERROR")
