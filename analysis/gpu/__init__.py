"""Pages in batches on a GPU, measured."""
