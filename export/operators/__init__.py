"""What execution providers can run: their operators by version and type, and which nodes of a graph they lack."""
